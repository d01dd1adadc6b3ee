"""Oracles: the same files with plain line ends, which other tests hold against their formats."""

import codecs
import json

import numpy as np
import pytest
from PIL import Image
from plain_text import FORMS

from attnwarp.editing.folder import config_of
from attnwarp.encoders.preprocess import read_json
from attnwarp.errors import InputError
from attnwarp.io import FileFormatError, read_colmap, read_dataset, read_ply, read_points
from attnwarp.io.text import read_text


@pytest.mark.parametrize("form", FORMS)
def test_text_of_any_editor_is_the_same_text(form, tmp_path):
    text = "first\n# größer\n\nlast 1 2\n"
    (tmp_path / "a.txt").write_bytes(FORMS[form](text))
    assert read_text(tmp_path / "a.txt").rstrip("\n") == text.rstrip("\n")


def colmap(folder):
    images = "1 1 0 0 0 0 0 4 1 a.png\n\n2 1 0 0 0 1 0 4 1 b.png\n1.5 2.5 -1\n"
    return {
        "cameras.txt": "# cameras\n1 PINHOLE 8 6 10 11 3.5 3.25\n",
        "images.txt": images,
        "points3D.txt": "5 0.5 -2.5 3 0 128 255 0.5\n",
    }


@pytest.mark.parametrize("form", FORMS)
def test_a_colmap_model_in_text_of_any_editor_is_the_same(form, tmp_path):
    models = []
    for name, write in (("plain", str.encode), ("other", FORMS[form])):
        (tmp_path / name / "images").mkdir(parents=True)
        for file, text in colmap(tmp_path).items():
            (tmp_path / name / file).write_bytes(write(text))
        for image in ("a.png", "b.png"):
            Image.new("RGB", (8, 6)).save(tmp_path / name / "images" / image)
        models.append(read_colmap(tmp_path / name))
    plain, other = models
    assert [c.name for c in other.cameras] == [c.name for c in plain.cameras] == ["a.png", "b.png"]
    for one, two in zip(plain.cameras, other.cameras, strict=True):
        assert np.array_equal(one.K, two.K)
        assert np.array_equal(one.world_to_camera, two.world_to_camera)
    assert np.array_equal(plain.points, other.points) and len(other.points) == 1


@pytest.mark.parametrize("form", FORMS)
def test_json_of_any_editor_is_the_same(form, tmp_path):
    data = {"camera_angle_x": 0.7, "w": 8, "h": 6, "frames": [
        {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    ]}  # fmt: skip
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")
    (tmp_path / "transforms.json").write_bytes(FORMS[form](json.dumps(data, indent=1)))
    (tmp_path / "config.json").write_bytes(FORMS[form](json.dumps({"größe": 3}, indent=1)))
    assert [c.name for c in read_dataset(tmp_path).cameras] == ["a.png"]
    assert read_json(tmp_path / "config.json") == {"größe": 3}
    (tmp_path / "unet").mkdir()
    (tmp_path / "config.json").rename(tmp_path / "unet" / "config.json")
    assert config_of(tmp_path, "unet") == {"größe": 3}


ENDS = {"unix": b"\n", "windows": b"\r\n", "old mac": b"\r"}


def ply(end, form, comment=b"comment made without end_header in mind"):
    """A cloud of two coloured points, by the format's description."""
    head = [b"ply", b"format %s 1.0" % form, comment, b"element vertex 2"]
    head += [b"property float %c" % c for c in b"xyz"]
    head += [b"property uchar %s" % c for c in (b"red", b"green", b"blue")]
    head += [b"end_header"]
    points = np.array([[1, 2, 3], [4, 5, 6.5]], "<f4")
    colors = np.array([[10, 13, 255], [13, 10, 0]], np.uint8)  # 10 and 13 end lines of text
    if form == b"ascii":
        rows = [b"%g %g %g %d %d %d" % (*p, *c) for p, c in zip(points, colors, strict=True)]
        return end.join([*head, *rows]) + end, points, colors
    body = b"".join(p.tobytes() + c.tobytes() for p, c in zip(points, colors, strict=True))
    return end.join(head) + end + body, points, colors


@pytest.mark.parametrize("form", [b"ascii", b"binary_little_endian"])
@pytest.mark.parametrize("end", ENDS)
def test_a_ply_of_any_system_is_read_whole_whatever_its_comments_say(end, form, tmp_path):
    data, points, colors = ply(ENDS[end], form)
    (tmp_path / "a.ply").write_bytes(data)
    read, tints = read_points(tmp_path / "a.ply")
    assert np.array_equal(read, points) and np.array_equal(tints, colors)
    # Rows that the header does not announce are still seen.
    (tmp_path / "b.ply").write_bytes(data + b"1 2 3 4 5 6" + ENDS[end])
    with pytest.raises(FileFormatError, match="left after the rows that the header announces"):
        read_points(tmp_path / "b.ply")


def by_name(columns, rows, names):
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    head += [f"property {kind} {name}" for name, kind in names.items()]
    return "\n".join([*head, "end_header", *(" ".join(map(str, row)) for row in rows)]) + "\n"


def test_splats_that_went_through_cloudcompare_are_read(tmp_path):
    """Oracle: the same rows under the trainers' own names."""
    own = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
           "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    rows = np.random.default_rng(0).normal(size=(3, len(own))).round(3).tolist()
    theirs = {n if n in "xyz" else f"scalar_{n}": "float" for n in own}
    (tmp_path / "a.ply").write_text(by_name(own, rows, dict.fromkeys(own, "float")))
    (tmp_path / "b.ply").write_text(by_name(own, rows, theirs))
    assert read_ply(tmp_path / "a.ply").digest() == read_ply(tmp_path / "b.ply").digest()


def test_bytes_that_are_no_text_are_still_refused_by_file(tmp_path):
    (tmp_path / "transforms.json").write_bytes(codecs.BOM_UTF8 + b"\xff\xfe{")
    with pytest.raises(InputError, match="transforms.json"):
        read_dataset(tmp_path)
