"""Names that another system wrote. The oracle is the file itself, each of another colour."""

import json
import warnings

import pytest
from PIL import Image

from attnwarp import Camera
from attnwarp.command.edit import mask_files, number_of, view_of
from attnwarp.io import (
    Dataset,
    read_colmap,
    read_image,
    read_transforms,
)
from attnwarp.io.names import file_stems

NAMES = ["images/left/é one.png", "images/right/B.png", "images/c.png"]
"""Names on the disk."""

SPELLINGS = {
    "windows": lambda name: ".\\" + name.replace("/", "\\"),
    "mixed": lambda name: name.replace("/", "\\", 1),
    "no suffix": lambda name: name.removesuffix(".png").replace("/", "\\"),
}


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def write_images(folder, names=NAMES, factor=1):
    for i, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8 // factor, 6 // factor), (i + 1, 0, 0)).save(folder / name)


def colours(dataset):
    return [int(read_image(path)[0, 0, 0]) for path in dataset.image_paths]


def transforms(folder, names, **more):
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    frames = []
    for i, name in enumerate(names):
        moved = [row[:] for row in pose]
        moved[0][3] = i
        frames.append({"file_path": name, "transform_matrix": moved})
    lens = {"w": 8, "h": 6, "fl_x": 9}
    path = folder / "transforms.json"
    path.write_text(json.dumps({**lens, "frames": frames, **more}), encoding="utf-8")
    return path


@pytest.mark.parametrize("spell", SPELLINGS.values(), ids=SPELLINGS)
def test_frames_find_their_images(tmp_path, spell):
    write_images(tmp_path)
    data = read_transforms(transforms(tmp_path, [spell(name) for name in NAMES]))
    assert colours(data) == [1, 2, 3]
    # The names of results know no folders.
    assert not any(set("/\\") & set(stem) for stem in file_stems(data.cameras))


@pytest.mark.parametrize("spell", ["windows", "mixed"])
def test_the_images_of_a_colmap_model_are_found(tmp_path, spell):
    write_images(tmp_path)
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 8 6 9 9 4 3")
    names = [SPELLINGS[spell](name.removeprefix("images/")) for name in NAMES]
    lines = [f"{i} 1 0 0 0 {i} 0 0 1 {name}\n\n" for i, name in enumerate(names)]
    (model / "images.txt").write_text("".join(lines), encoding="utf-8")
    data = read_colmap(tmp_path, points=False)
    by_place = sorted(zip([c.position[0] for c in data.cameras], colours(data), strict=True))
    assert [colour for _, colour in reversed(by_place)] == [1, 2, 3]


def views(*names):
    view = {"width": 8, "height": 6, "fov_y": 40}
    return [Camera.look_at((3, 0, 0), (0, 0, 0), name=name, **view) for name in names]


def test_masks_are_found_by_the_names_of_views(tmp_path):
    names = [name.removeprefix("images/") for name in NAMES]
    write_images(tmp_path, names)
    files = mask_files(tmp_path, views(*names))
    assert [int(read_image(file)[0, 0, 0]) for file in files] == [1, 2, 3]


def test_a_source_view_is_found_by_its_name_with_or_without_suffix():
    cameras = views("left/a.png", "right/B.png", "c.png")
    for name in ("right/B.png", "B.png", "B"):
        assert number_of([camera.name for camera in cameras], name) == 1


def test_the_source_view_is_one_that_splats_are_fitted_to():
    cameras = views("a.png", "b.png", "c.png", "d.png")
    paths = ["a.png", None, "c.png", "d.png"]
    data = Dataset(cameras, paths, splits=["test", "train", "val", "train"])
    assert view_of(data, None) == 2
    assert view_of(Dataset(cameras, paths), None) == 0
