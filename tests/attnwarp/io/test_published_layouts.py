"""Data sets of the field in the layouts they are published in, written here. Oracle: the cameras they were written from."""

import json

import numpy as np
import pytest

from attnwarp import Camera
from attnwarp.io import FileFormatError, read_dataset
from attnwarp.io.picture import encode_picture

W, H = 50, 34
OPENGL = np.diag([1.0, -1, -1, 1])


@pytest.fixture
def cameras():
    """Three cameras with a principal point of their own."""
    made = []
    for k in range(3):
        camera = Camera.look_at(
            (3 * np.sin(k), -3 * np.cos(k), 0.5), (0, 0, 0), width=W, height=H, fov_y=40
        )
        K = camera.K.copy()
        K[:2, 2] += (1.5, -0.75)
        made.append(Camera(K, camera.world_to_camera, W, H, name=f"frame_{k + 1:05d}.jpg"))
    return made


def picture(folder, name, width, height):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(encode_picture(np.full((height, width, 3), 90, np.uint8), ".jpg"))


def apple_double(path):
    """Write the file that macOS puts beside another one (RFC 1740: its number and version)."""
    path.with_name(f"._{path.name}").write_bytes(bytes.fromhex("0005160700020000") + bytes(18))


def scaled_folders(root, cameras, scales=(1, 2, 4, 8)):
    for scale in scales:
        for camera in cameras:
            # ImageMagick rounds halves up, so sides are not exact parts.
            size = [int(side / scale + 0.5) for side in (W, H)]
            picture(root / ("images" if scale == 1 else f"images_{scale}"), camera.name, *size)


def nerfstudio(root, cameras):
    """Instruct-NeRF2NeRF: a transforms.json of nerfstudio with image folders by scale."""
    frames = [
        {"file_path": f"images/{c.name}",
         "transform_matrix": (np.linalg.inv(c.world_to_camera) @ OPENGL).tolist()}
        for c in cameras
    ]  # fmt: skip
    K = cameras[0].K
    top = {"w": W, "h": H, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
           "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV"}  # fmt: skip
    root.mkdir(exist_ok=True)
    (root / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    scaled_folders(root, cameras)


def mipnerf360(root, cameras):
    """Mip-NeRF 360: a binary COLMAP model in sparse/0, image folders by scale, poses_bounds.npy."""
    import pycolmap

    model = pycolmap.Reconstruction()
    K = cameras[0].K
    own = pycolmap.Camera(
        model="PINHOLE", width=W, height=H, params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera_id=1
    )
    model.add_camera_with_trivial_rig(own)
    for k, camera in enumerate(cameras, start=1):
        pose = pycolmap.Rigid3d(camera.world_to_camera[:3])
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=camera.name, camera_id=1, image_id=k), pose
        )
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write(folder)
    np.save(root / "poses_bounds.npy", np.zeros((3, 17)))
    scaled_folders(root, cameras)


def blendedmvs(root, cameras):
    """BlendedMVS: MVSNet's cameras, images with and without background, depth maps, and what macOS
    writes beside them.
    """
    (root / "cams").mkdir(parents=True)
    for k, camera in enumerate(cameras):
        rows = lambda M: "\n".join(" ".join(f"{v:.17g}" for v in row) for row in M)  # noqa: E731
        (root / "cams" / f"{k:08d}_cam.txt").write_text(
            f"extrinsic\n{rows(camera.world_to_camera)}\n\nintrinsic\n{rows(camera.K)}\n\n2.1 0.02 128 4.9\n"
        )
        picture(root / "blended_images", f"{k:08d}.jpg", W, H)
        picture(root / "blended_images", f"{k:08d}_masked.jpg", W, H)
        apple_double(root / "cams" / f"{k:08d}_cam.txt")
        apple_double(root / "blended_images" / f"{k:08d}.jpg")
    (root / "cams" / "pair.txt").write_text("3\n0\n2 1 9.0 2 8.0\n")
    (root / "rendered_depth_maps").mkdir()


def check(read, cameras, width, height):
    assert len(read) == len(cameras)
    for got, camera in zip(read.cameras, cameras, strict=True):
        assert (got.width, got.height) == (width, height)
        np.testing.assert_allclose(got.world_to_camera, camera.world_to_camera, atol=1e-9)
        # Pixels of the small picture are those of the large one, moved by the ratio of the sizes.
        points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
        expected = camera.project(points)[0] * [width / W, height / H]
        np.testing.assert_allclose(got.project(points)[0], expected, atol=1e-6)
    assert all(path.is_file() for path in read.image_paths)


@pytest.mark.parametrize("write", [nerfstudio, mipnerf360])
@pytest.mark.parametrize(
    ("scale", "size"), [(1, (50, 34)), (2, (25, 17)), (4, (13, 9)), (8, (6, 4))]
)
def test_every_scale_of_the_images_is_read_with_its_cameras(tmp_path, cameras, write, scale, size):
    write(tmp_path / "scene", cameras)
    read = read_dataset(tmp_path / "scene", scale=scale)
    check(read, cameras, *size)
    assert {path.parent.name for path in read.image_paths} == {
        "images" if scale == 1 else f"images_{scale}"
    }


def test_a_scene_of_blendedmvs_is_read_without_its_masked_copies(tmp_path, cameras):
    blendedmvs(tmp_path / "scene", cameras)
    read = read_dataset(tmp_path / "scene")
    check(read, cameras, W, H)
    assert [path.name for path in read.image_paths] == [f"{k:08d}.jpg" for k in range(3)]


def test_a_missing_scale_names_its_folder(tmp_path, cameras):
    nerfstudio(tmp_path / "scene", cameras)
    for path in (tmp_path / "scene" / "images_4").iterdir():
        path.unlink()
    with pytest.raises(FileFormatError, match="3 of 3 images are missing: .*images_4"):
        read_dataset(tmp_path / "scene", scale=4)
    with pytest.raises(ValueError, match=r"scale \(--scale\): got 3, expected one of 1, 2, 4, 8"):
        read_dataset(tmp_path / "scene", scale=3)


@pytest.mark.door
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("extrinsic", "pose"), "'extrinsic' is not in list"),
        (lambda text: text.replace("intrinsic\n", "intrinsic\nnan "), "expected 9 finite ones"),
        (
            lambda text: text[: text.index("intrinsic") + 20],
            "could not convert|numbers, expected 9",
        ),
        (lambda text: text.replace("0 0 0 1", "0 0 0 2", 1), "expected 0 0 0 1"),
        (lambda text: text.replace("intrinsic\n", "intrinsic\n-"), "expected a pinhole"),
    ],
)
def test_a_damaged_camera_is_named(tmp_path, cameras, change, message):
    blendedmvs(tmp_path / "scene", cameras)
    path = tmp_path / "scene" / "cams" / "00000001_cam.txt"
    path.write_text(change(path.read_text()))
    with pytest.raises(FileFormatError, match=message) as raised:
        read_dataset(tmp_path / "scene")
    assert "00000001_cam.txt" in str(raised.value)


@pytest.mark.door
def test_images_that_are_missing_are_named_or_left_out(tmp_path, cameras):
    blendedmvs(tmp_path / "scene", cameras)
    (tmp_path / "scene" / "blended_images" / "00000001.jpg").unlink()
    with pytest.raises(FileFormatError, match=r"1 of 3 images are missing: .*00000001\.jpg"):
        read_dataset(tmp_path / "scene")
    check(read_dataset(tmp_path / "scene", missing_images="none"), cameras[::2], W, H)
    for path in (tmp_path / "scene" / "blended_images").glob("*.jpg"):
        path.unlink()
    with pytest.raises(FileFormatError, match="none of the pictures in blended_images"):
        read_dataset(tmp_path / "scene", missing_images="none")
    with pytest.raises(ValueError, match="BlendedMVS has one folder of images"):
        read_dataset(tmp_path / "scene", scale=2)
