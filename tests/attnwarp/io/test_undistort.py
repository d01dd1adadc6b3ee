"""Lens distortion against OpenCV's formulas, and undistorted pictures against COLMAP's own."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from attnwarp import Camera
from attnwarp.cli.main import app
from attnwarp.errors import InputError
from attnwarp.fit import load_views
from attnwarp.io import (
    Dataset,
    FileFormatError,
    Lens,
    read_colmap,
    read_dataset,
    read_image,
    undistort,
    undistorted_camera,
    undistorted_image,
)

SIZE = (64, 48)
FOCAL = [50.0, 52.0]
CENTER = [31.0, 25.0]

MODELS = {
    "SIMPLE_RADIAL": ([-0.1], Lens("brown", (-0.1,))),
    "RADIAL": ([-0.15, 0.03], Lens("brown", (-0.15, 0.03))),
    "OPENCV": ([-0.2, 0.05, 0.003, -0.002], Lens("brown", (-0.2, 0.05, 0.003, -0.002))),
    "FULL_OPENCV": (
        [0.2, 0.05, 0.003, -0.002, 0.01, 0.1, 0.02, 0.003],
        Lens("brown", (0.2, 0.05, 0.003, -0.002, 0.01, 0.1, 0.02, 0.003)),
    ),
    "SIMPLE_RADIAL_FISHEYE": ([-0.05], Lens("fisheye", (-0.05,))),
    "RADIAL_FISHEYE": ([-0.05, 0.01], Lens("fisheye", (-0.05, 0.01))),
    "OPENCV_FISHEYE": ([-0.05, 0.01, 0.002, -0.001], Lens("fisheye", (-0.05, 0.01, 0.002, -0.001))),
}


def params_of(model):
    focal = FOCAL[:1] if "RADIAL" in model else FOCAL
    return [*focal, *CENTER, *MODELS[model][0]]


def camera_of(model):
    fy = FOCAL[0] if "RADIAL" in model else FOCAL[1]
    K = np.array([[FOCAL[0], 0, CENTER[0]], [0, fy, CENTER[1]], [0, 0, 1]])
    return Camera(K, np.eye(4), *SIZE, "a.png")


def smooth(seed=0):
    pixels = np.random.default_rng(seed).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    return cv2.resize(pixels, SIZE, interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("model", MODELS)
def test_points_are_distorted_as_by_opencv(model):
    lens, camera = MODELS[model][1], camera_of(model)
    xy = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    points = np.c_[xy, np.ones(200)]
    still = np.zeros(3)
    if lens.kind == "fisheye":
        k = np.array(lens.coefficients)
        expected, _ = cv2.fisheye.projectPoints(points[:, None], still, still, camera.K, k)
    else:
        k = np.array(lens.coefficients)
        expected, _ = cv2.projectPoints(points, still, still, camera.K, k)
    ours = lens.distort(xy) * [camera.K[0, 0], camera.K[1, 1]] + CENTER
    np.testing.assert_allclose(ours, expected[:, 0], atol=1e-9)
    # The inverse is judged by OpenCV's forward formula, through the equality above.
    np.testing.assert_allclose(lens.undistort(lens.distort(xy)), xy, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_pictures_are_those_of_colmaps_own_undistorter(model):
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params_of(model))
    pixels = smooth()
    bitmap, pinhole = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(pixels), theirs
    )
    fx, fy, cx, cy = pinhole.params
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    target = Camera(K, np.eye(4), pinhole.width, pinhole.height)
    ours = undistorted_image(pixels, camera_of(model), MODELS[model][1], target)
    assert ours.any()
    # One step of 8 bits where a value lies between two of them; pixels at the rim that only one of
    # the two takes for seen.
    away = np.abs(ours.astype(int) - bitmap.to_array()).max(axis=2) > 1
    inside = away[2:-2, 2:-2]
    assert not inside.any() and away.mean() < 0.01
    # Their camera is as large, up to the whole pixels that ours keeps.
    own = undistorted_camera(camera_of(model), MODELS[model][1])
    assert abs(own.width - pinhole.width) <= 3 and abs(own.height - pinhole.height) <= 3


@pytest.mark.parametrize("model", MODELS)
def test_the_undistorted_camera_sees_no_blank_pixel_and_could_not_be_larger(model):
    camera, lens = camera_of(model), MODELS[model][1]
    white = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    target = undistorted_camera(camera, lens)
    assert (undistorted_image(white, camera, lens, target) == 255).all()
    larger = Camera(
        target.K + np.array([[0, 0, 2], [0, 0, 2], [0, 0, 0]]),
        np.eye(4),
        target.width + 4,
        target.height + 4,
    )
    seen = undistorted_image(white, camera, lens, larger)[..., 0] == 255
    assert not seen.all(axis=0)[[0, -1]].all() or not seen.all(axis=1)[[0, -1]].all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_colour_of_transparent_pixels_does_not_bleed_into_their_neighbours(dtype):
    camera, lens = camera_of("OPENCV"), Lens("brown", (-0.1,))
    top = np.iinfo(dtype).max
    image = np.full((SIZE[1], SIZE[0], 4), top, dtype)
    image[..., 3] = 0
    image[12:36, 16:48] = (top, 0, 0, top)  # red on transparent white
    target = undistorted_camera(camera, lens)
    seen = undistorted_image(image, camera, lens, target)
    rim = seen[(seen[..., 3] > 0) & (seen[..., 3] < top)]
    assert len(rim) > 50 and (rim[:, :3] == (top, 0, 0)).all()
    # Alpha, and the picture over black, are resampled as they are without the other.
    over_black = image[..., :3] * (image[..., 3:] > 0)
    expected = undistorted_image(over_black.astype(dtype), camera, lens, target)
    shown = seen[..., :3] * (seen[..., 3:].astype(float) / top)
    np.testing.assert_allclose(shown, expected, atol=1)


@pytest.mark.parametrize(
    ("k1", "k2", "k3"),
    [
        (0.435, 0.253, -0.199),
        (0.427, 0.374, -0.194),
        (0.302, 0.339, -0.094),
        (0.094, 0.279, -0.142),
    ],
)
@pytest.mark.parametrize("tangential", [(0.0, 0.0), (0.002, -0.001)])
def test_points_before_a_fold_are_found_however_far_the_lens_moves_them(k1, k2, k3, tangential):
    """Newton's method from where they are shown ends beyond the fold, or at the opposite side."""
    r = np.linspace(0, 2, 20001)
    shown = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    fold = r[np.argmax(np.diff(shown) < 0)]
    assert 1 < fold < 2
    radii, angles = np.meshgrid(np.linspace(0, 0.9 * fold, 50), np.linspace(0, 6, 25))
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles)], -1)
    lens = Lens("brown", (k1, k2, *tangential, k3))
    np.testing.assert_allclose(lens.undistort(lens.distort(points)), points, atol=1e-9)
    # A picture that reaches to nine tenths of the fold.
    focal = 32 / lens.distort([0.9 * fold, 0.0])[0]
    K = np.array([[focal, 0, 32], [0, focal, 4], [0, 0, 1]])
    assert undistorted_camera(Camera(K, np.eye(4), 64, 8), lens).width < 64


def first_turn(k):
    """First radius at which r (1 + k1 r^2 + ...), or an angle's polynomial, turns."""
    slope = [0.0] * (2 * len(k) + 1)
    slope[::2] = [(2 * i + 1) * c for i, c in enumerate((1.0, *k))]
    roots = np.roots(slope[::-1])
    return min(roots[(abs(roots.imag) < 1e-9) & (roots.real > 0)].real, default=np.inf)


@pytest.mark.parametrize("kind", ["brown", "fisheye"])
def test_a_picture_is_undistorted_if_and_only_if_its_corners_lie_before_the_first_turn(kind):
    """Beyond a second turn, or on the other side of the axis, a border has an inverse again."""
    rng, kept, refused = np.random.default_rng(4), 0, 0
    while min(kept, refused) < 20:
        k = tuple(rng.normal(0, 1, 2) * rng.choice([0.1, 1, 3]))
        focal, corner = rng.uniform(15, 90), np.hypot(31.5, 23.5)
        camera = Camera(np.array([[focal, 0, 32], [0, focal, 24], [0, 0, 1]]), np.eye(4), *SIZE)
        turn = first_turn(k)
        if turn > (1.4 if kind == "fisheye" else np.tan(1.4)):
            continue  # beyond the steepest rays of a picture
        largest = turn * (1 + k[0] * turn**2 + k[1] * turn**4)
        if abs(corner / focal - largest) < 0.02:
            continue  # too near to tell
        lens = Lens(kind, k if kind == "fisheye" else (*k, 0.0, 0.0))
        if corner / focal > largest:
            refused += 1
            with pytest.raises(ValueError, match=r"fold the picture of camera '' over"):
                undistorted_camera(camera, lens)
            continue
        kept += 1
        target = undistorted_camera(camera, lens)
        radius = np.linalg.norm(target.directions()[..., :2], axis=-1).max()
        assert (np.arctan(radius) if kind == "fisheye" else radius) < turn
        assert target.width > 16 and target.height > 16


def test_a_lens_that_folds_is_refused_by_the_command_with_the_cameras_name(tmp_path):
    data = constant_pictures(tmp_path / "in", ["a.png"], reds=(0,))
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    # r (1 - 0.7 r^2 - 0.9 r^4) turns at 0.56; the corner of 64 x 48 px lies at 0.8.
    top = {"w": 64, "h": 48, "fl_x": 50.0, "k1": -0.7, "k2": -0.9, "frames": [frame]}
    (data.image_paths[0].parent / "transforms.json").write_text(json.dumps(top))
    done = CliRunner().invoke(app, ["undistort", str(tmp_path / "in"), str(tmp_path / "out")])
    assert done.exit_code == 2 and "fold the picture of camera '0.png'" in done.stderr
    assert not (tmp_path / "out/images").exists()


def test_a_wide_fisheye_is_cut_to_twice_its_size():
    K = np.array([[20.0, 0, 32], [0, 20.0, 24], [0, 0, 1]])
    camera = Camera(K, np.eye(4), *SIZE)
    target = undistorted_camera(camera, Lens("fisheye", ()))
    assert (target.width, target.height) == (128, 96)
    np.testing.assert_allclose([target.K[0, 2], target.K[1, 2]], [64, 48], atol=1)


def test_a_data_set_is_undistorted_and_then_fitted_on(tmp_path):
    (tmp_path / "in/images").mkdir(parents=True)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=1).as_matrix()
    frames = []
    for name in ("left/a.png", "right/a.png"):
        (tmp_path / "in" / name).parent.mkdir(exist_ok=True)
        Image.fromarray(smooth()).save(tmp_path / "in" / name)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = dict(zip(("k1", "k2", "p1", "p2"), MODELS["OPENCV"][0], strict=True))
    top = {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 52.0, "cx": 31.0, "cy": 25.0, **lens}
    top |= {"train_filenames": ["left/a.png"], "test_filenames": ["right/a.png"]}
    (tmp_path / "in/transforms.json").write_text(json.dumps({**top, "frames": frames}))
    with pytest.raises(FileFormatError, match="attnwarp undistort"):
        read_dataset(tmp_path / "in")
    data = read_dataset(tmp_path / "in", distorted="keep")
    with pytest.raises(FileFormatError, match="undistort the data set first"):
        load_views(data)
    undistort(data, tmp_path / "out")
    back = read_dataset(tmp_path / "out")
    assert back.splits == ["train", "test"] and back.lenses == [None, None]
    assert [str(p.relative_to(tmp_path / "out")) for p in back.image_paths] == [
        "images/left/a.png", "images/right/a.png",
    ]  # fmt: skip
    np.testing.assert_allclose(back.cameras[0].rotation, data.cameras[0].rotation, atol=1e-12)
    # A point of the world is where its distorted pixel has gone: the same colour, interpolated.
    target = back.cameras[0]
    xy = np.array([20.5, 15.5])
    source = cv2.projectPoints(
        target.directions(xy)[None], np.zeros(3), np.zeros(3), data.cameras[0].K,
        np.array(MODELS["OPENCV"][1].coefficients),
    )[0][0, 0]  # fmt: skip
    patch = cv2.getRectSubPix(smooth().astype(np.float32), (1, 1), source - 0.5)[0, 0]
    shown = read_image(back.image_paths[0])[15, 20]
    np.testing.assert_allclose(shown, patch, atol=1)
    assert len(load_views(back)) == 2


def constant_pictures(folder, names, reds=(0, 80, 160)):
    """A data set of pictures of one colour each; their files' names are apart."""
    folder.mkdir(parents=True)
    paths = [folder / f"{red}.png" for red in reds]
    for path, red in zip(paths, reds, strict=True):
        Image.new("RGB", SIZE, (red, 0, 0)).save(path)
    cameras = [dataclasses.replace(camera_of("OPENCV"), name=name) for name in names]
    return Dataset(cameras, paths, lenses=[Lens("brown", (-0.1,))] * len(cameras))


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["a.jpg", "a.png", "b.png"], ["0000-a.png", "0001-a.png", "b.png"]),
        (["images/r.0001", "images/r.0002", "images/r.0003"], [f"000{i}-r.png" for i in range(3)]),
        (["images/s/a", "s/a", "s/0000-a"], ["s/0000-0000-a.png", "s/0001-a.png", "s/0000-a.png"]),
        (["", "000000.png", "c.v2.png"], ["0000-000000.png", "0001-000000.png", "c.v2.png"]),
    ],
)
def test_every_view_has_a_picture_of_its_own(tmp_path, names, files):
    data = constant_pictures(tmp_path / "in", names)
    undistort(data, tmp_path / "out")
    back = read_dataset(tmp_path / "out")
    # One colour stays one colour, however it is resampled.
    assert [np.unique(read_image(p)[..., 0]).tolist() for p in back.image_paths] == [
        [0],
        [80],
        [160],
    ]
    assert [str(p.relative_to(tmp_path / "out/images")) for p in back.image_paths] == files


def test_a_capture_that_is_there_is_not_written_over(tmp_path):
    data = constant_pictures(tmp_path / "in", ["a.png", "b.png", "c.png"])
    undistort(data, tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")}
    with pytest.raises(InputError, match=r"transforms.json: is there; name another folder"):
        undistort(data, tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")} == before


@pytest.mark.parametrize(
    ("lens", "shown"),
    # r - 0.3 r^3 rises up to 0.703, t - 0.5 t^3 to 0.544.
    [(Lens("brown", (-0.3,)), 0.703), (Lens("fisheye", (-0.5,)), 0.544)],
)
def test_what_is_found_is_an_inverse_and_all_else_is_undefined(lens, shown):
    points = np.stack([np.linspace(0, 1.5, 151), np.linspace(0, 0.1, 151)], -1)
    back = lens.undistort(points)
    found = np.isfinite(back).all(-1)
    assert found[np.linalg.norm(points, axis=-1) < shown - 0.01].all()
    np.testing.assert_allclose(lens.distort(back[found]), points[found], atol=1e-8)


@pytest.mark.parametrize("link", [False, True])
def test_no_picture_that_is_read_is_written_over(tmp_path, link):
    # The second of three is written to the place of the third.
    data = constant_pictures(tmp_path / "out/images", ["a.png", "160.png", "b.png"])
    folder = tmp_path / "out"
    if link:
        folder = tmp_path / "another name"
        folder.symlink_to("out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")}
    with pytest.raises(InputError, match=r"160.png: is a picture to undistort; name another"):
        undistort(data, folder)
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")} == before


def test_a_model_that_colmap_writes_is_read_with_its_lens(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    for model, (_, lens) in MODELS.items():
        reconstruction = pycolmap.Reconstruction()
        camera = pycolmap.Camera(
            camera_id=1, model=model, width=64, height=48, params=params_of(model)
        )
        reconstruction.add_camera_with_trivial_rig(camera)
        turn = Rotation.random(random_state=2).as_quat()
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.array([0.1, -0.2, 3.0]))
        image = pycolmap.Image(image_id=1, camera_id=1, name="a.png")
        reconstruction.add_image_with_trivial_frame(image, pose)
        folder = tmp_path / model
        folder.mkdir()
        reconstruction.write(folder)
        Image.fromarray(smooth()).save(folder / "a.png")
        data = read_colmap(folder, images=folder, distorted="keep")
        assert data.lenses == [lens]
        np.testing.assert_allclose(data.cameras[0].K, camera_of(model).K)
        point = np.array([0.2, 0.1, 0.4])
        theirs = reconstruction.image(1).project_point(point)
        local = data.cameras[0].world_to_camera[:3] @ np.append(point, 1)
        ours = lens.distort(local[:2] / local[2])
        K = data.cameras[0].K
        np.testing.assert_allclose(ours * [K[0, 0], K[1, 1]] + K[:2, 2], theirs, atol=1e-9)
