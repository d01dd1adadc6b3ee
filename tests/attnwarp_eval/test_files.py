"""Oracles: the file system, the standard library's JSON reader, Pillow."""

import io
import json
import math

import numpy as np
import pytest
from PIL import Image

from attnwarp.io.picture import encode_picture
from attnwarp_eval import canonical_json, files


def test_numbers_that_json_lacks_become_null_and_all_others_stay():
    value = {"a": [1, 2.5, math.nan], "b": (math.inf, -math.inf), "c": np.float32(0.5), "d": None}
    plain = canonical_json.without_nan(value)
    assert plain == {"a": [1, 2.5, None], "b": [None, None], "c": 0.5, "d": None}
    assert json.loads(canonical_json.canonical_json(plain)) == plain
    assert canonical_json.without_nan({"n": np.int64(3), "t": True}) == {"n": 3, "t": True}
    assert type(canonical_json.without_nan(np.int64(3))) is int


def test_json_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "a.json"
    canonical_json.write_json(path, {"b": 1, "a": [1.5]})
    assert json.loads(path.read_text()) == {"a": [1.5], "b": 1}
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json.write_json(path, math.nan)
    assert json.loads(path.read_text()) == {"a": [1.5], "b": 1}
    assert [p.name for p in path.parent.iterdir()] == ["a.json"]


def test_pictures_read_back_as_pillow_reads_them(tmp_path):
    image = np.random.default_rng(0).random((7, 9, 3))
    image[0, 0], image[0, 1] = (-1, 0.5, 2), (0, 1, 0.25)
    expected = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    path = files.write_picture(tmp_path / "deep" / "a.png", image)
    assert np.array_equal(np.asarray(Image.open(path)), expected)
    assert encode_picture(expected) == path.read_bytes()
    smooth = np.full((16, 16, 3), (0.2, 0.5, 0.7))
    for chroma, layers in (("444", (1, 1)), ("420", (2, 2))):
        data = encode_picture(smooth, ".jpg", quality=88, chroma=chroma)
        read = Image.open(io.BytesIO(data))
        assert read.layer[0][1:3] == layers  # Pillow: (component, horizontal, vertical, table)
        assert np.abs(np.asarray(read) / 255 - smooth).max() < 0.02


@pytest.mark.parametrize(
    ("shape", "suffix", "words"),
    [((4, 4), ".png", r"image: got shape \(4, 4\)"), ((4, 4, 3), ".gif", "suffix: got '.gif'")],
)
def test_pictures_of_another_shape_or_kind_are_refused(shape, suffix, words):
    with pytest.raises(ValueError, match=words):
        encode_picture(np.zeros(shape), suffix)
