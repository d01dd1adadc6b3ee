"""Oracle: editors that answer a flat colour for every instruction, or for the depth."""

import numpy as np

from attnwarp_eval.drawn.worlds import OBJECTS
from training.assess.sheets import ROWS, SCALE, depth_sheet, sheet, write_sheet
from training.worlds.editing_pairs import LOOKS, SIZE, VIEWS, Worlds


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


def test_a_sheet_of_depth_maps_names_each_worlds_thing_and_shows_its_own_depth():
    n, blank = 3, np.zeros(1)
    images = np.zeros((n, VIEWS, LOOKS, SIZE, SIZE, 3), np.uint8)
    ids = np.zeros((n, VIEWS, SIZE, SIZE), np.uint8)
    things = np.array([OBJECTS.index(name) for name in ("mug", "car", "tree")])
    # The left half is three times as far away as the right.
    depth = np.where(np.arange(SIZE) < SIZE // 2, 6.0, 2.0)
    depth = np.broadcast_to(depth, (n, VIEWS, SIZE, SIZE)).astype(np.float32)
    valid = np.ones((n, LOOKS), bool)
    worlds = Worlds(images, valid, things, blank, blank, ids, depth, blank, blank)
    asked = []

    def draw(prompts, row, text, seed):
        asked.append((row.world, text))
        return np.full((SIZE, SIZE, 3), 0.2 * (1 + things[row.world] % 3), np.float32)

    picture = depth_sheet(draw, worlds, size=SIZE, descriptions=["a red {} at night"])
    places = np.linspace(0, n - 1, ROWS).astype(int)
    names = [("mug", "car", "tree")[k] for k in places]
    assert asked == [(k, f"a red {name} at night") for k, name in zip(places, names, strict=True)]
    pixels = np.asarray(picture)
    side = SIZE * SCALE
    head = pixels.shape[0] - ROWS * side
    rows = pixels[head + side // 2 :: side]
    np.testing.assert_array_equal(
        rows[:, side + side // 2, 0], np.rint(51 * (1 + things[places] % 3))
    )
    assert (rows[:, 3 * side // 4, 0] > rows[:, side // 4, 0]).all()
