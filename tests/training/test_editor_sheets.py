"""Oracle: an editor that answers a flat colour for every instruction."""

import numpy as np

from training.editing_pairs import LOOKS, SIZE, VIEWS, Worlds
from training.editor_sheets import ROWS, SCALE, sheet, write_sheet


def test_a_sheet_has_a_row_a_world_and_a_column_an_instruction(tmp_path):
    n, blank = 3, np.zeros(1)
    images = np.full((n, VIEWS, LOOKS, SIZE, SIZE, 3), 90, np.uint8)
    ids = np.zeros((n, VIEWS, SIZE, SIZE), np.uint8)
    valid = np.ones((n, LOOKS), bool)
    worlds = Worlds(images, valid, blank, blank, blank, ids, blank, blank, blank)
    tones = {"make it red": (1.0, 0.0, 0.0), "paint it blue": (0.0, 0.0, 1.0)}

    def answer(before, text, seed):
        return np.broadcast_to(np.array(tones[text], np.float32), before.shape)

    path = write_sheet(
        sheet(answer, worlds, size=64, instructions=list(tones)), tmp_path / "a" / "sheet.png"
    )
    from PIL import Image

    pixels = np.asarray(Image.open(path))
    side = 64 * SCALE
    head = pixels.shape[0] - ROWS * side
    assert pixels.shape == (head + ROWS * side, 3 * side, 3)
    middle = pixels[head + side // 2 :: side, side // 2 :: side]
    assert np.array_equal(middle[:, 0], np.full((ROWS, 3), 90))
    assert np.array_equal(middle[:, 1], np.tile([255, 0, 0], (ROWS, 1)))
    assert np.array_equal(middle[:, 2], np.tile([0, 0, 255], (ROWS, 1)))
