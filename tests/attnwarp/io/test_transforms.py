import json
import math
import warnings

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from attnwarp import Camera
from attnwarp.fit import load_views
from attnwarp.io import (
    Dataset,
    FileFormatError,
    read_dataset,
    read_points,
    read_transforms,
    undistort,
    write_transforms,
)


def image(path, size=(8, 6)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path)
    return path


def pose(seed=0):
    """A camera-to-world matrix in OpenGL axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return matrix


LENS = {"w": 8, "h": 6, "fl_x": 10.0, "fl_y": 11.0, "cx": 3.5, "cy": 3.25}


def write(folder, frames, name="transforms.json", **top):
    for frame in frames:
        if isinstance(frame, dict) and isinstance(frame.get("transform_matrix"), np.ndarray):
            frame["transform_matrix"] = frame["transform_matrix"].tolist()
    (folder / name).write_text(json.dumps({**top, "frames": frames}))
    return folder / name


def folder_of(tmp_path, n=3, **top):
    frames = []
    for i in range(n):
        image(tmp_path / f"images/{i:03}.png")
        frames.append({"file_path": f"images/{i:03}.png", "transform_matrix": pose(i)})
    return write(tmp_path, frames, **(LENS | top))


def test_points_project_by_the_opengl_camera_formula(tmp_path):
    data = read_transforms(folder_of(tmp_path))
    points = np.random.default_rng(9).normal(size=(200, 3)) * 3
    seen = 0
    for i, camera in enumerate(data.cameras):
        local = (np.linalg.inv(pose(i)) @ np.c_[points, np.ones(200)].T).T
        front = local[:, 2] < 0  # OpenGL looks along -z
        seen += front.sum()
        u = 3.5 + 10.0 * local[:, 0] / -local[:, 2]
        v = 3.25 - 11.0 * local[:, 1] / -local[:, 2]  # y is up there, and down in the image
        xy, z = camera.project(points)
        np.testing.assert_allclose(z, -local[:, 2], atol=1e-13)
        np.testing.assert_allclose(xy[front], np.c_[u, v][front], rtol=1e-9, atol=1e-9)
        assert (camera.width, camera.height, camera.name) == (8, 6, f"images/{i:03}.png")
    assert seen > 100


def test_a_blender_file_gives_focal_length_from_the_angle_and_the_size_from_the_image(tmp_path):
    image(tmp_path / "train/r_0.png", (800, 600))
    matrix = np.eye(4)
    matrix[2, 3] = 5
    frames = [{"file_path": "./train/r_0", "rotation": 0.01, "transform_matrix": matrix}]
    data = read_transforms(
        write(tmp_path, frames, "transforms_train.json", camera_angle_x=math.radians(90))
    )
    (camera,) = data.cameras
    # tan 45 = 1: half of 800 pixels; square pixels; the middle of the image.
    np.testing.assert_allclose(camera.K, [[400, 0, 400], [0, 400, 300], [0, 0, 1]], rtol=1e-15)
    assert data.image_paths == [tmp_path / "train/r_0.png"] and data.splits == ["train"]
    xy, z = camera.project([[0, 0, 0], [0, 1, 0], [1, 0, 0]])
    np.testing.assert_allclose(xy, [[400, 300], [400, 220], [480, 300]])  # up is up, right is right
    assert z.tolist() == [5, 5, 5]


def test_a_folder_with_three_blender_files_is_read_as_one_with_splits(tmp_path):
    for split, n in (("train", 3), ("val", 1), ("test", 2)):
        frames = []
        for i in range(n):
            image(tmp_path / split / f"r_{i}.png")
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose(i)})
        write(tmp_path, frames, f"transforms_{split}.json", camera_angle_x=0.7)
    data = read_dataset(tmp_path)
    assert data.splits == ["train"] * 3 + ["val"] + ["test"] * 2
    assert [camera.name for camera in data.split("test").cameras] == ["test/r_0", "test/r_1"]
    with pytest.raises(ValueError, match="got 'eval', expected one of 'test', 'train', 'val'"):
        data.split("eval")


def test_a_frames_own_intrinsics_win_over_those_at_the_top(tmp_path):
    image(tmp_path / "a.png")
    image(tmp_path / "b.png", (16, 12))
    frames = [
        {"file_path": "a.png", "transform_matrix": pose(0)},
        {
            "file_path": "b.png",
            "transform_matrix": pose(1),
            "w": 16.0,
            "h": 12,
            "camera_angle_x": 1.0,
            "cx": 8,
        },
    ]
    a, b = read_transforms(write(tmp_path, frames, **LENS)).cameras
    assert a.K.tolist() == [[10, 0, 3.5], [0, 11, 3.25], [0, 0, 1]]
    f = 8 / math.tan(0.5)
    np.testing.assert_allclose(b.K, [[f, 0, 8], [0, f, 3.25], [0, 0, 1]])


@pytest.mark.parametrize(
    ("top", "frame", "focal"),
    [
        ({"fl_y": 11.0}, {"fl_x": None, "camera_angle_x": 1.0}, 4 / math.tan(0.5)),
        ({"fl_x": "auto"}, {"camera_angle_x": 1.0}, 4 / math.tan(0.5)),
        ({"fl_x": 10.0, "fl_y": 11.0}, {"fl_x": 9.0, "fl_y": None}, 9.0),
    ],
)
def test_a_focal_length_that_the_frame_leaves_open_is_not_compared(tmp_path, top, frame, focal):
    """w / 2 / tan(angle / 2) by hand; pixels are square."""
    image(tmp_path / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": pose(), **frame}
    (camera,) = read_transforms(write(tmp_path, [frame], w=8, h=6, **top)).cameras
    np.testing.assert_allclose(camera.K[[0, 1], [0, 1]], focal, rtol=1e-15)


@pytest.mark.parametrize("noise", ["float32", "five digits"])
def test_a_rotation_with_small_noise_becomes_the_nearest_rotation(tmp_path, noise):
    matrix = pose(4)
    image(tmp_path / "a.png")
    noisy = (
        matrix.astype(np.float32).astype(np.float64) if noise == "float32" else np.round(matrix, 5)
    )
    path = write(tmp_path, [{"file_path": "a.png", "transform_matrix": noisy}], **LENS)
    (camera,) = read_transforms(path).cameras
    R = camera.rotation
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
    # No further from the matrix it was rounded from than twice the rounding.
    assert np.abs(R.T * [1, -1, -1] - matrix[:3, :3]).max() < (
        1.2e-7 if noise == "float32" else 2e-5
    )
    np.testing.assert_allclose(camera.position, noisy[:3, 3], atol=1e-14)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda m: m @ np.diag([2, 2, 2, 1]), ["max |R R^T - I| = 3", "length 2"]),
        (lambda m: m + np.eye(4) * [2e-3, 0, 0, 0], ["not orthonormal", "0.00"]),
        (lambda m: m @ np.diag([1, 1, -1, 1]), ["mirrors"]),
        (lambda m: m.T, ["last row", "transposed"]),
        (lambda m: m * np.nan, ["finite"]),
        (lambda m: m[:2], ["4 x 4"]),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused_with_frame_and_size_of_the_error(
    tmp_path, change, parts
):
    image(tmp_path / "a.png")
    image(tmp_path / "b.png")
    frames = [
        {"file_path": "a.png", "transform_matrix": pose(0)},
        {"file_path": "b.png", "transform_matrix": change(pose(1))},
    ]
    path = write(tmp_path, frames, **LENS)
    with pytest.raises(FileFormatError) as caught:
        read_transforms(path)
    for part in [str(path), "frames[1] (b.png): transform_matrix", *parts]:
        assert part in str(caught.value)


@pytest.mark.door
@pytest.mark.parametrize(
    ("top", "parts"),
    [
        ({"k1": -0.02}, ["k1", "-0.02", "undistort"]),
        ({"camera_model": "OPENCV_FISHEYE"}, ["camera_model", "fisheye", "undistort"]),
        ({"fl_x": "ten"}, ["fl_x", "'ten'", "number"]),
        ({"fl_x": -3}, ["fl_x", "positive"]),
        ({"w": 8.5}, ["w, h", "whole numbers"]),
        ({"cx": math.nan}, ["cx", "finite"]),
        ({"camera_angle_x": 4.0, "fl_x": None}, ["camera_angle_x", "radians"]),
        ({"fl_x": None, "fl_y": None}, ["fl_x", "camera_angle_x"]),
        ({"ply_file_path": "none.ply"}, ["ply_file_path", "none.ply is missing"]),
        ({"train_filenames": "images/000.png"}, ["train_filenames", "list"]),
    ],
)
def test_what_cannot_be_used_is_refused_naming_the_key(tmp_path, top, parts):
    path = folder_of(tmp_path, **top)
    with pytest.raises(FileFormatError) as caught:
        read_transforms(path)
    for part in [str(path), *parts]:
        assert part in str(caught.value), str(caught.value)


@pytest.mark.door
@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "empty"),
        ("{", "not JSON"),
        ("[]", "frames"),
        ('{"frames": []}', "frames"),
        ('{"frames": [3]}', "frames[0]"),
        ('{"frames": [{}]}', "frames[0].file_path"),
        ("\xff", "not JSON: 'utf-8' codec can't decode byte 0xff in position 0"),
    ],
)
def test_what_is_no_transforms_file_is_refused(tmp_path, text, part):
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(FileFormatError) as caught:
        read_dataset(tmp_path)
    assert part in str(caught.value)


@pytest.mark.door
def test_missing_images_are_listed_and_can_be_waived(tmp_path):
    path = folder_of(tmp_path, n=7)
    for i in (1, 2, 4, 5, 6):
        (tmp_path / f"images/{i:03}.png").unlink()
    with pytest.raises(FileFormatError) as caught:
        read_transforms(path)
    for part in ("5 of 7", "001.png", "002.png", "004.png", "and 2 more"):
        assert part in str(caught.value)
    assert "005.png" not in str(caught.value)
    data = read_transforms(path, missing_images="none")
    assert [p is None for p in data.image_paths] == [False, True, True, False, True, True, True]
    assert len(data.cameras) == 7


@pytest.mark.parametrize(("orientation", "turned"), [(1, False), (3, False), (6, True), (8, True)])
def test_a_picture_whose_tag_asks_for_a_turn_is_told_from_one_of_another_size(
    tmp_path, orientation, turned
):
    frames = [{"file_path": "images/a.jpg", "transform_matrix": pose()}]
    path = write(tmp_path, frames, **{**LENS, "w": 6, "h": 8})
    picture = Image.new("RGB", (8, 6))
    exif = picture.getexif()
    exif[274] = orientation
    (tmp_path / "images").mkdir()
    picture.save(tmp_path / "images/a.jpg", exif=exif)
    message = (
        "stored as 8 x 6 with an EXIF tag .* camera is 6 x 8" if turned else "is 8 x 6, but its"
    )
    for resize in (False, True) if turned else (False,):
        with pytest.raises(FileFormatError, match=message):
            read_transforms(path, resize_cameras=resize)
    # Where sides fit as stored, the tag is said.
    upright = write(tmp_path, frames, **LENS)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert len(read_transforms(upright).cameras) == 1
    assert [str(each.message) for each in said] == [
        f"{upright}: 1 of 1 images have an EXIF tag that asks for a turn (first:"
        f" {tmp_path / 'images/a.jpg'}); it is not followed, since a pose belongs to the pixels as"
        " they are stored"
    ] * (orientation != 1)


def test_no_camera_is_resized_to_a_picture_of_another_shape(tmp_path):
    # No resampling turns 4:3 into 3:4; a side may be rounded: 8 x 6 by 0.4 is 3.2 x 2.4.
    path = folder_of(tmp_path)
    image(tmp_path / "images/001.png", (3, 2))
    assert read_transforms(path, resize_cameras=True).cameras[1].width == 3
    image(tmp_path / "images/001.png", (6, 8))
    message = r"001.png: got 8 x 6 \(height x width\), expected the aspect ratio of 6 x 8; turn"
    with pytest.raises(FileFormatError, match=message):
        read_transforms(path, resize_cameras=True)


def dataset_of(tmp_path, focal=(9.0, 9.0)):
    cameras, paths = [], []
    for i, f in enumerate(focal):
        camera = Camera.look_at((3 + i, 1e4, 2), (0, 1e4 + 1, 0), width=8, height=6, fov_y=50)
        K = np.array([[f, 0, 4.125], [0, 1.1 * f, 2.75], [0, 0, 1]])
        cameras.append(Camera(K, camera.world_to_camera, 8, 6, f"view {i}"))
        paths.append(image(tmp_path / f"images/view {i}.png"))
    points = np.random.default_rng(0).normal(size=(11, 3)) * 1e5
    colors = np.random.default_rng(1).integers(0, 256, (11, 3)).astype(np.uint8)
    return Dataset(cameras, paths, points, colors)


@pytest.mark.parametrize("focal", [(9.0, 9.0), (9.0, 12.5)])
def test_what_is_written_is_read_back(tmp_path, focal):
    data = dataset_of(tmp_path, focal)
    data.splits = ["train", "test"]
    write_transforms(tmp_path, data)
    back = read_dataset(tmp_path)
    for a, b in zip(data.cameras, back.cameras, strict=True):
        assert np.array_equal(a.K, b.K) and np.array_equal(a.rotation, b.rotation)
        # One rounding on the way to the centre and one back, at 1e4: 2e-12 each.
        assert np.abs(a.position - b.position).max() < 1e-11
        assert (a.width, a.height) == (b.width, b.height)
    assert back.image_paths == data.image_paths and back.splits == data.splits
    assert np.array_equal(back.points, data.points) and np.array_equal(back.colors, data.colors)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("folder", ["link", "link/inner", "data"])
def test_what_is_written_through_a_link_is_read_back(tmp_path, folder):
    """A folder that is a link, one inside it, and images that lie behind one."""
    (tmp_path / "deep/er/inner").mkdir(parents=True)
    (tmp_path / "link").symlink_to("deep/er")
    (tmp_path / "data").mkdir()
    path = image(tmp_path / ("link/a.png" if folder == "data" else "imgs/a.png"))
    camera = Camera.look_at((3, 1, 2), (0, 1, 0), width=8, height=6, fov_y=50)
    write_transforms(tmp_path / folder, Dataset([camera], [path]))
    (read,) = read_dataset(tmp_path / folder).image_paths
    assert read.samefile(path)


def test_the_written_file_says_what_other_readers_look_for(tmp_path):
    write_transforms(tmp_path / "transforms.json", dataset_of(tmp_path))
    data = json.loads((tmp_path / "transforms.json").read_text())
    assert data["frames"][1]["file_path"] == "images/view 1.png"
    assert data["fl_x"] == 9.0 and data["w"] == 8 and "fl_x" not in data["frames"][0]
    assert data["camera_angle_x"] == pytest.approx(2 * math.atan(8 / 2 / 9.0), rel=1e-15)
    matrix = np.array(data["frames"][0]["transform_matrix"])
    assert matrix[:3, 3].tolist() == pytest.approx([3, 1e4, 2])
    forward = np.array([-3, 1, -2]) / math.sqrt(14)
    np.testing.assert_allclose(-matrix[:3, 2], forward, atol=1e-12)  # OpenGL looks along -z
    assert matrix[2, 1] > 0  # and its y is up, as the world's z is
    assert len(read_points(tmp_path / data["ply_file_path"])[0]) == 11


@pytest.mark.door
def test_cameras_without_images_are_written_by_name_and_skew_is_refused(tmp_path):
    camera = Camera.look_at((3, 1, 2), (0, 0, 0), width=8, height=6, fov_y=50, name="front")
    write_transforms(tmp_path, Dataset([camera], [None]))
    back = read_transforms(tmp_path, missing_images="none")
    assert back.cameras[0].name == "front" and back.image_paths == [None] and back.points is None
    K = camera.K + np.array([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]])
    skewed = Camera(K, camera.world_to_camera, 8, 6, "front")
    with pytest.raises(ValueError, match=r"camera 0 has skew 0\.5"):
        write_transforms(tmp_path, Dataset([skewed], [None]))
    nameless = Camera(camera.K, camera.world_to_camera, 8, 6)
    with pytest.raises(ValueError, match="neither an image nor a name"):
        write_transforms(tmp_path, Dataset([nameless], [None]))


def test_a_dataset_checks_its_lists():
    camera = Camera.look_at((3, 1, 2), (0, 0, 0), width=8, height=6, fov_y=50)
    with pytest.raises(ValueError, match="image_paths: got 0, expected 1"):
        Dataset([camera], [])
    with pytest.raises(ValueError, match="colors: given without points"):
        Dataset([camera], [None], colors=np.zeros((1, 3), np.uint8))
    with pytest.raises(ValueError, match="colors: got float64"):
        Dataset([camera], [None], np.zeros((1, 3)), np.zeros((1, 3)))


# -------- keys that change the picture


def brown(folder, top=(), frame=()):
    image(folder / "a.png")
    frames = [{"file_path": "a.png", "transform_matrix": pose(0), **dict(frame)}]
    return write(folder, frames, **(LENS | dict(top)))


LISTED = [-0.02, 0.01, 0.003, 0.0, 1e-4, -2e-4]
NAMED = {"k1": -0.02, "k2": 0.01, "k3": 0.003, "p1": 1e-4, "p2": -2e-4}


@pytest.mark.door
@pytest.mark.parametrize("level", ["top", "frame"])
@pytest.mark.parametrize("keys", [{"distortion_params": LISTED}, NAMED])
def test_distortion_is_refused_or_handed_on_wherever_it_stands(tmp_path, level, keys):
    path = brown(tmp_path, **{level: keys})
    with pytest.raises(FileFormatError, match=r"frames\[0\] \(a.png\): k1.*-0.02.*undistort"):
        read_transforms(path)
    (lens,) = read_transforms(path, distorted="keep").lenses
    # nerfstudio's list is k1 k2 k3 k4 p1 p2, OpenCV's vector k1 k2 p1 p2 k3.
    assert lens.kind == "brown"
    assert lens.coefficients == (-0.02, 0.01, 1e-4, -2e-4, 0.003, 0.0, 0.0, 0.0)


@pytest.mark.door
@pytest.mark.parametrize(
    ("top", "frame", "part"),
    [
        ({"distortion_params": [0.1]}, {}, "six numbers"),
        ({"distortion_params": ["a", 0, 0, 0, 0, 0]}, {}, "six numbers"),
        ({"distortion_params": LISTED, "k1": 0.5}, {}, "differs from distortion_params"),
        ({"k4": 0.1}, {}, "k4"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, {}, "p1"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, "camera_model"),
    ],
)
def test_distortion_that_could_mean_two_things_is_refused(tmp_path, top, frame, part):
    with pytest.raises(FileFormatError, match=part):
        read_transforms(brown(tmp_path, top, frame), distorted="keep")


def test_a_list_of_zeros_is_a_pinhole(tmp_path):
    data = read_transforms(brown(tmp_path, {"distortion_params": [0.0] * 6}))
    assert data.lenses == [None]


@pytest.mark.door
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mask_path", "masks/a.png"),
        ("rolling_shutter", [0, 0, 0.1, 0]),
        ("transform_matrix_start", [[1, 0, 0, 0]]),
        ("latlong", True),
        ("skew", 0.5),
        ("white_transparent", True),
    ],
)
@pytest.mark.parametrize("level", ["top", "frame"])
def test_a_key_that_changes_the_picture_is_refused_unless_it_is_waived(tmp_path, key, value, level):
    path = brown(tmp_path, **{level: {key: value}})
    with pytest.raises(FileFormatError, match=rf"{key}: .*--ignore-key {key}"):
        read_transforms(path)
    assert len(read_transforms(path, ignore_keys=[key])) == 1


def test_keys_that_change_nothing_pass(tmp_path):
    top = {"aabb_scale": 16, "scale": 0.3, "rolling_shutter": [0, 0, 0, 0], "latlong": False}
    read_transforms(brown(tmp_path, top, {"sharpness": 30.0, "colmap_im_id": 3}))


# -------- splits


def split_names(tmp_path, spell):
    return {
        "train_filenames": [spell("images/000.png"), spell("images/002.png")],
        "test_filenames": [spell("images/001.png")],
    }


@pytest.mark.parametrize(
    "spell",
    [
        lambda name: name,
        lambda name: f"./{name}",
        lambda name: name.replace("/", "//"),
        lambda name: f"images/../{name}",
        lambda name: name.removesuffix(".png"),
    ],
)
def test_names_of_splits_are_compared_as_paths(tmp_path, spell):
    path = folder_of(tmp_path, **split_names(tmp_path, spell))
    assert read_transforms(path).splits == ["train", "test", "train"]
    path = folder_of(tmp_path, **split_names(tmp_path, lambda name: str(tmp_path / spell(name))))
    assert read_transforms(path).splits == ["train", "test", "train"]


@pytest.mark.door
def test_names_of_frames_that_were_removed_by_hand_are_refused_with_the_remedy_that_mends_it(
    tmp_path,
):
    """Oracle: the file reads once the message is followed."""
    path = folder_of(tmp_path, **split_names(tmp_path, lambda name: name))
    data = json.loads(path.read_text())
    removed = data["frames"].pop(0)["file_path"]
    path.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match=r"train_filenames: .*remove their names too, or al"):
        read_transforms(path)
    data["train_filenames"] = [name for name in data["train_filenames"] if name != removed]
    path.write_text(json.dumps(data))
    assert read_transforms(path).splits == ["test", "train"]


def test_a_frame_to_fit_on_is_not_held_out_as_well(tmp_path):
    lists = split_names(tmp_path, lambda name: name)
    lists["val_filenames"] = ["images/002.png"]
    with pytest.raises(FileFormatError, match=r"val_filenames: 'images/002.png' is in train_fil"):
        read_transforms(folder_of(tmp_path, **lists))
    lists["val_filenames"] = lists["test_filenames"]  # as nerfstudio's own files have it
    assert read_transforms(folder_of(tmp_path, **lists)).splits == ["train", "test", "train"]


def test_empty_lists_split_nothing_and_are_no_reason_to_warn(tmp_path, recwarn):
    lists = {key: [] for key in split_names(tmp_path, lambda name: name)}
    data = read_transforms(folder_of(tmp_path, **lists))
    assert data.splits == [None] * 3
    assert not recwarn.list


@pytest.mark.parametrize("held_out", ["test", "val"])
def test_nerfstudio_finds_all_three_splits_in_what_we_write(tmp_path, held_out):
    """Its dataparser: with any of the lists there, each of the three must be, and is looked up."""
    data = dataset_of(tmp_path)
    data.splits = ["train", held_out]
    write_transforms(tmp_path, data)
    written = json.loads((tmp_path / "transforms.json").read_text())
    for split, index in (("train", 0), ("val", 1), ("test", 1)):
        assert written[f"{split}_filenames"] == [written["frames"][index]["file_path"]]
    assert read_dataset(tmp_path).splits == ["train", "test"]


def test_masks_are_read_with_the_pictures_and_follow_an_undistortion(tmp_path):
    """A shrunk pixel is ignored where any of it is; a bent one, where its place in the mask is."""
    image(tmp_path / "a.png", (48, 32))
    dark = np.full((32, 48), 255, np.uint8)
    dark[5:20, 10:31] = 0
    Image.fromarray(dark).save(tmp_path / "m.png")
    frame = {"file_path": "a.png", "transform_matrix": pose(0), "mask_path": "m.png"}
    flat = {"w": 48, "h": 32, "fl_x": 40.0}
    data = read_transforms(write(tmp_path, [frame], **flat))
    (mask,) = load_views(data, max_size=24).masks
    np.testing.assert_array_equal(mask, dark.reshape(16, 2, 24, 2).min(axis=(1, 3)) > 0)
    assert load_views(read_transforms(tmp_path, ignore_keys=["mask_path"])).masks == [None]
    bent = read_transforms(write(tmp_path, [frame], **flat, k1=-0.1), distorted="keep")
    undistort(bent, tmp_path / "flat")
    again = read_transforms(tmp_path / "flat")
    (mask,) = load_views(again).masks
    camera, lens = bent.cameras[0], bent.lenses[0]
    rays = again.cameras[0].directions()
    xy = (camera.K[:2, :2] @ lens.distort(rays.reshape(-1, 3)[:, :2]).T).T + camera.K[:2, 2]
    column, row = np.floor(xy).astype(int).T.reshape(2, *mask.shape)
    nearest = dark[row.clip(0, 31), column.clip(0, 47)] > 0
    assert (mask <= nearest).all() and (mask != nearest).mean() < 0.08  # its border
    (tmp_path / "m.png").unlink()
    with pytest.raises(FileFormatError, match="mask_path: got 'm.png', which is not there"):
        read_transforms(write(tmp_path, [frame], **flat))
