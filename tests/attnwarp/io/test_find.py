"""Names that another system wrote. The oracle is the file itself, each of another colour."""

import json
import re
import unicodedata
import warnings

import numpy as np
import pytest
from PIL import Image

from attnwarp import Camera
from attnwarp.command.edit import mask_files, number_of, view_of
from attnwarp.errors import InputError
from attnwarp.io import (
    Dataset,
    FileFormatError,
    read_colmap,
    read_dataset,
    read_image,
    read_transforms,
)
from attnwarp.io.names import file_stems

NAMES = ["images/left/é one.png", "images/right/B.png", "images/c.png"]
"""Names on the disk."""

SPELLINGS = {
    "windows": lambda name: ".\\" + name.replace("/", "\\"),
    "mixed": lambda name: name.replace("/", "\\", 1),
    "upper": str.upper,
    "lower": str.lower,
    "url": lambda name: name.replace("é", "%C3%A9").replace(" ", "%20"),
    "decomposed": lambda name: unicodedata.normalize("NFD", name),
    "all": lambda name: unicodedata.normalize("NFD", name.upper()).replace("/", "\\"),
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


@pytest.mark.parametrize("spell", ["windows", "upper", "all"])
def test_smaller_copies_and_the_points_are_found_too(tmp_path, spell):
    write_images(tmp_path)
    write_images(tmp_path, [name.replace("images", "images_2") for name in NAMES], factor=2)
    (tmp_path / "Points").mkdir()
    text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    (tmp_path / "Points/a.ply").write_text(f"{text}property float z\nend_header\n1 2 3\n")
    names = [SPELLINGS[spell](name) for name in NAMES]
    path = transforms(tmp_path, names, ply_file_path=SPELLINGS[spell]("Points/a.ply"))
    data = read_transforms(path, scale=2)
    assert colours(data) == [1, 2, 3] and data.cameras[0].width == 4
    assert data.points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("spell", SPELLINGS.values(), ids=SPELLINGS)
def test_the_images_of_a_colmap_model_are_found(tmp_path, spell):
    if spell is SPELLINGS["no suffix"]:
        pytest.skip("COLMAP's names have their suffix")
    write_images(tmp_path)
    (tmp_path / "images").rename(tmp_path / "Images")
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 8 6 9 9 4 3")
    names = [spell(name.removeprefix("images/")) for name in NAMES]
    lines = [f"{i} 1 0 0 0 {i} 0 0 1 {name}\n\n" for i, name in enumerate(names)]
    (model / "images.txt").write_text("".join(lines), encoding="utf-8")
    data = read_colmap(tmp_path, points=False)
    by_place = sorted(zip([c.position[0] for c in data.cameras], colours(data), strict=True))
    assert [colour for _, colour in reversed(by_place)] == [1, 2, 3]


def test_a_published_scene_with_other_suffixes_is_read(tmp_path):
    (tmp_path / "cams").mkdir()
    text = "extrinsic\n1 0 0 0\n0 1 0 0\n0 0 1 2\n0 0 0 1\n\nintrinsic\n9 0 4\n0 9 3\n0 0 1\n"
    (tmp_path / "cams/00000000_cam.txt").write_text(text)
    write_images(tmp_path, ["blended_images/00000000.JPG"])
    assert len(read_dataset(tmp_path)) == 1


def test_the_own_name_comes_first_and_two_that_might_be_meant_are_both_named(tmp_path):
    write_images(tmp_path, ["images/a.png", "images/A.png"])
    names = ["images/A.png", "images/a.png"]
    assert colours(read_transforms(transforms(tmp_path, names))) == [2, 1]
    with pytest.raises(FileFormatError, match=r"images/A\.png and .*images/a\.png are there"):
        read_transforms(transforms(tmp_path, ["Images/a.png"]))


def test_a_file_whose_name_has_a_backslash_is_taken_as_it_is(tmp_path):
    write_images(tmp_path, ["images/a.png", "images\\a.png"])
    names = ["images\\a.png", "images/a.png"]
    assert colours(read_transforms(transforms(tmp_path, names))) == [2, 1]
    (tmp_path / "images/a.png").unlink()  # as an archive of Windows is unpacked
    assert colours(read_transforms(transforms(tmp_path, ["images/a.png"]))) == [2]


@pytest.mark.door
@pytest.mark.parametrize(
    "name",
    ["C:\\Users\\me\\scene\\images\\c.png", "/home/other/scene/images/c.png", "photos/C.PNG"],
)
def test_a_path_of_another_machine_is_refused_with_the_file_that_is_there(tmp_path, name):
    write_images(tmp_path, ["images/c.png"] if "photos" not in name else ["c.png"])
    found = tmp_path / ("images/c.png" if "photos" not in name else "c.png")
    with pytest.raises(FileFormatError, match=rf"; {re.escape(str(found))} is there;"):
        read_transforms(transforms(tmp_path, [name]))


def views(*names):
    view = {"width": 8, "height": 6, "fov_y": 40}
    return [Camera.look_at((3, 0, 0), (0, 0, 0), name=name, **view) for name in names]


@pytest.mark.parametrize("spell", ["upper", "lower", "url", "decomposed"])
def test_masks_are_found_and_none_serves_two_views(tmp_path, spell):
    write_images(tmp_path, [SPELLINGS[spell](name.removeprefix("images/")) for name in NAMES])
    cameras = views(*(name.removeprefix("images/") for name in NAMES))
    files = mask_files(tmp_path, cameras)
    assert [int(read_image(file)[0, 0, 0]) for file in files] == [1, 2, 3]
    with pytest.raises(InputError, match=r"could be that of c\.png or of C\.png"):
        mask_files(tmp_path, views("c.png", "C.png"))


def test_image_of_another_form_is_not_read_twice_from_the_disk(tmp_path, monkeypatch):
    """Each folder is listed once, however many names are spelled otherwise."""
    names = [f"images/{i}.png" for i in range(50)]
    write_images(tmp_path, names)
    path = transforms(tmp_path, [name.upper() for name in names])
    listed = []
    real = type(tmp_path).iterdir
    monkeypatch.setattr(type(tmp_path), "iterdir", lambda self: listed.append(self) or real(self))
    data = read_transforms(path)
    assert colours(data) == [i + 1 for i in range(50)]
    assert sorted(listed) == [tmp_path, tmp_path / "images"]
    np.testing.assert_array_equal([c.position[0] for c in data.cameras], range(50))


@pytest.mark.parametrize("name", ["RIGHT\\B.png", "right/b.PNG", "b", "RIGHT%2FB.png"])
def test_a_source_view_is_found_by_another_spelling_of_its_name(name):
    cameras = views("left/a.png", "right/B.png", "c.png")
    assert number_of([camera.name for camera in cameras], name) == 1


def test_the_source_view_is_one_that_splats_are_fitted_to():
    cameras = views("a.png", "b.png", "c.png", "d.png")
    paths = ["a.png", None, "c.png", "d.png"]
    data = Dataset(cameras, paths, splits=["test", "train", "val", "train"])
    assert view_of(data, None) == 2
    assert view_of(Dataset(cameras, paths), None) == 0
