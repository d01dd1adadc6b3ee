import struct
import warnings

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from attnwarp.errors import InputWarning
from attnwarp.io import FileFormatError, read_colmap, read_dataset

IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 6}

CAMERAS = [
    (7, "PINHOLE", 8, 6, (10.0, 11.0, 3.5, 3.25)),
    (3, "SIMPLE_PINHOLE", 8, 6, (12.5, 4.0, 3.0)),
]


def poses(n=3):
    out = []
    for i in range(n):
        x, y, z, w = Rotation.random(random_state=i).as_quat()
        t = np.random.default_rng(i).normal(size=3) + np.array([0, 0, 4])
        # Ids and names in different orders, a name with a space and one in a folder.
        names = ["b/second view.png", "c.png", "a.png"]
        out.append(
            (
                90 - i,
                (w, x, y, z),
                tuple(t),
                7 if i else 3,
                names[i] if i < 3 else f"d{i}.png",
                2 * (i % 2),
            )
        )
    return out


POINTS = [(5, (0.1, -2.5, 3e5), (0, 128, 255), 2), (1, (1 / 3, 0, -1), (9, 8, 7), 0)]


def write_binary(folder, cameras=CAMERAS, images=None, points=POINTS):
    """The binary layout of colmap.github.io/format.html and its reconstruction_io, little
    endian."""
    folder.mkdir(parents=True, exist_ok=True)
    images = poses() if images is None else images
    data = struct.pack("<Q", len(cameras))
    for camera, model, w, h, params in cameras:
        data += struct.pack("<IiQQ", camera, IDS.get(model, model), w, h) + struct.pack(
            f"<{len(params)}d", *params
        )
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for image, q, t, camera, name, keypoints in images:
        data += struct.pack("<I4d3dI", image, *q, *t, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", keypoints) + b"".join(
            struct.pack("<ddq", 1.5, 2.5, -1) for _ in range(keypoints)
        )
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for point, xyz, rgb, track in points:
        data += struct.pack("<Q3d3Bd", point, *xyz, *rgb, 0.5)
        data += struct.pack("<Q", track) + struct.pack("<II", 1, 2) * track
    (folder / "points3D.bin").write_bytes(data)
    return folder


def write_text(folder, cameras=CAMERAS, images=None, points=POINTS):
    folder.mkdir(parents=True, exist_ok=True)
    images = poses() if images is None else images
    lines = [
        "# Camera list with one line of data per camera:",
        f"# Number of cameras: {len(cameras)}",
    ]
    lines += [
        " ".join(map(repr, [c, w, h, *p])).replace(" ", f" {m} ", 1) for c, m, w, h, p in cameras
    ]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for image, q, t, camera, name, keypoints in images:
        lines += [f"{image} {' '.join(repr(float(v)) for v in (*q, *t))} {camera} {name}"]
        lines += [" ".join(["1.5 2.5 -1"] * keypoints)]  # empty without keypoints
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# 3D point list"]
    for point, xyz, rgb, track in points:
        lines += [" ".join(map(str, [point, *map(float, xyz), *rgb, 0.5])) + " 1 2" * track]
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    return folder


def pictures(folder, size=(8, 6), images=None):
    for _, _, _, _, name, _ in poses() if images is None else images:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size).save(folder / name)


@pytest.mark.parametrize("write", [write_binary, write_text])
def test_cameras_images_and_points_are_those_of_the_file(tmp_path, write):
    write(tmp_path / "sparse/0")
    pictures(tmp_path / "images")
    data = read_dataset(tmp_path)
    expected = sorted(poses(), key=lambda image: image[4])
    assert [camera.name for camera in data.cameras] == ["a.png", "b/second view.png", "c.png"]
    assert data.image_paths == [tmp_path / "images" / image[4] for image in expected]
    points = np.random.default_rng(5).normal(size=(100, 3))
    for camera, (_, (w, x, y, z), t, lens, _, _) in zip(data.cameras, expected, strict=True):
        # COLMAP: camera = R world + t, then u = f x/z + c, with pixel centres at +0.5 as here.
        local = Rotation.from_quat([x, y, z, w]).apply(points) + t
        fx, fy, cx, cy = (10.0, 11.0, 3.5, 3.25) if lens == 7 else (12.5, 12.5, 4.0, 3.0)
        front = local[:, 2] > 0
        assert front.sum() > 20
        xy, depth = camera.project(points)
        np.testing.assert_allclose(depth, local[:, 2], atol=1e-13)
        u, v = fx * local[:, 0] / local[:, 2] + cx, fy * local[:, 1] / local[:, 2] + cy
        np.testing.assert_allclose(xy[front], np.c_[u, v][front], rtol=1e-9, atol=1e-9)
    assert np.array_equal(data.points, [xyz for _, xyz, _, _ in POINTS])
    assert data.colors.dtype == np.uint8 and np.array_equal(
        data.colors, [rgb for _, _, rgb, _ in POINTS]
    )


def test_text_and_binary_give_the_same_cameras_bit_for_bit(tmp_path):
    a = read_colmap(write_binary(tmp_path / "a"), missing_images="none")
    b = read_colmap(write_text(tmp_path / "b"), missing_images="none")
    for one, other in zip(a.cameras, b.cameras, strict=True):
        assert one.to_dict() == other.to_dict()


def test_the_binary_model_wins_where_both_are_there(tmp_path):
    write_text(tmp_path, points=[])
    write_binary(tmp_path)
    assert len(read_colmap(tmp_path, missing_images="none").points) == 2


def test_a_quaternion_is_normalised_and_a_zero_one_refused(tmp_path):
    image = (1, (2.0, 0.0, 0.0, 0.0), (0, 0, 1), 7, "a.png", 0)
    write_text(tmp_path, images=[image])
    assert np.array_equal(
        read_colmap(tmp_path, missing_images="none").cameras[0].rotation, np.eye(3)
    )
    write_text(tmp_path, images=[(1, (0, 0, 0, 0), (0, 0, 1), 7, "a.png", 0)])
    with pytest.raises(FileFormatError, match=r"image 'a.png': got quaternion"):
        read_colmap(tmp_path, missing_images="none")
    write_text(tmp_path, images=[(1, (1, 0, 0, 0), (0, float("nan"), 1), 7, "a.png", 0)])
    with pytest.raises(FileFormatError, match=r"image 'a.png'.*nan"):
        read_colmap(tmp_path, missing_images="none")


@pytest.mark.parametrize("write", [write_binary, write_text])
@pytest.mark.parametrize(
    ("model", "count"), [("SIMPLE_RADIAL", 4), ("OPENCV", 8), ("FULL_OPENCV", 12)]
)
def test_a_lens_model_with_distortion_is_named_with_the_remedy(tmp_path, write, model, count):
    lens = (7, model, 8, 6, (10.0, 4.0, 3.0, *[0.0] * (count - 4), 1e-3))
    write(tmp_path, cameras=[lens, CAMERAS[1]])
    with pytest.raises(FileFormatError, match=rf"{model}.*expected PINHOLE.*image_undistorter"):
        read_colmap(tmp_path, missing_images="none")


@pytest.mark.parametrize("write", ["write_text", "write_binary"])
def test_no_coefficient_of_full_opencv_is_lost(tmp_path, write):
    """Each of the eight alone, in files that pycolmap writes, against its own projection."""
    pycolmap = pytest.importorskip("pycolmap")
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    for k in range(9):
        distortion = [0.02 if k == j else 0.0 for j in range(8)]
        camera = pycolmap.Camera(
            camera_id=1, model="FULL_OPENCV", width=64, height=48,
            params=[50, 52, 31, 25, *distortion],
        )  # fmt: skip
        reconstruction = pycolmap.Reconstruction()
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(image_id=1, camera_id=1, name="a.png")
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        getattr(reconstruction, write)(str(tmp_path))
        if k == 8:  # without any, it is a pinhole
            assert read_colmap(tmp_path, missing_images="none").lenses == [None]
            continue
        with pytest.raises(FileFormatError, match="FULL_OPENCV"):
            read_colmap(tmp_path, missing_images="none")
        data = read_colmap(tmp_path, missing_images="none", distorted="keep")
        ours = data.lenses[0].distort(rays) * (50, 52) + (31, 25)
        theirs = camera.img_from_cam(np.column_stack([rays, np.ones(20)]))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)
        assert np.abs(ours - (rays * (50, 52) + (31, 25))).max() > 1e-3


def test_a_distorted_camera_that_no_image_uses_does_not_matter(tmp_path):
    write_binary(tmp_path, cameras=[*CAMERAS, (1, "OPENCV", 8, 6, (1.0,) * 8)])
    assert len(read_colmap(tmp_path, missing_images="none")) == 3


@pytest.mark.door
def test_a_model_id_that_is_not_known_is_refused(tmp_path):
    write_binary(tmp_path, cameras=[(7, 42, 8, 6, (1.0,))])
    with pytest.raises(FileFormatError, match=r"model: got id 42.*newer COLMAP"):
        read_colmap(tmp_path, missing_images="none")


@pytest.mark.door
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_binary_file_cut_anywhere_says_what_is_missing(tmp_path, name):
    write_binary(tmp_path)
    whole = (tmp_path / name).read_bytes()
    for cut in range(1, len(whole)):
        (tmp_path / name).write_bytes(whole[:cut])
        with pytest.raises(FileFormatError) as caught:
            read_colmap(tmp_path, missing_images="none")
        assert name in str(caught.value)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(FileFormatError, match="empty"):
        read_colmap(tmp_path, missing_images="none")
    (tmp_path / name).write_bytes(whole + b"\0")
    with pytest.raises(FileFormatError, match="1 bytes are left"):
        read_colmap(tmp_path, missing_images="none")


@pytest.mark.door
def test_counts_that_are_too_large_end_in_an_error_and_not_in_a_long_wait(tmp_path):
    write_binary(tmp_path)
    whole = (tmp_path / "points3D.bin").read_bytes()
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2**62) + whole[8:])
    with pytest.raises(FileFormatError, match=r"while reading point 2 of 46"):
        read_colmap(tmp_path, missing_images="none")


@pytest.mark.door
@pytest.mark.parametrize(
    ("name", "line", "parts"),
    [
        ("cameras.txt", "7 PINHOLE 8", ["line 1", "CAMERA_ID MODEL"]),
        ("cameras.txt", "7 PINHOLE 8 6 10 11 3", ["line 1", "4 parameters"]),
        ("cameras.txt", "7 PINHOLE 8 6 10 11 3 -", ["line 1", "CAMERA_ID MODEL"]),
        ("images.txt", "1 1 0 0 0 0 0 1 7", ["line 1", "QW QX QY QZ"]),
        ("images.txt", "1 1 0 0 0 0 zero 1 7 a.png", ["line 1", "QW QX QY QZ"]),
        ("images.txt", "1 1 0 0 0 0 0 1 8 a.png", ["camera 8", "not in cameras.txt"]),
        ("images.txt", "# nothing", ["no registered image"]),
        ("points3D.txt", "1 0 0", ["line 1", "POINT3D_ID"]),
        ("points3D.txt", "1 0 0 0 0 0 256 1", ["line 1", "POINT3D_ID"]),
        ("points3D.txt", "1 0 nan 0 0 0 25 1", ["point 0", "not finite"]),
        ("cameras.txt", "7 PINHOLE 8 6 0 11 3 3", ["camera 7", "focal lengths"]),
    ],
)
def test_a_damaged_line_is_named(tmp_path, name, line, parts):
    write_text(tmp_path, images=[poses()[1]])
    (tmp_path / name).write_text(line + "\n")
    with pytest.raises(FileFormatError) as caught:
        read_colmap(tmp_path, missing_images="none")
    for part in (name, *parts):
        assert part in str(caught.value), str(caught.value)


@pytest.mark.door
def test_an_image_where_keypoints_belong_is_refused_and_not_skipped(tmp_path):
    write_text(tmp_path)
    first, second = "1 1 0 0 0 0 0 1 7 a.png", "2 1 0 0 0 0 0 1 7 b.png"
    (tmp_path / "images.txt").write_text(f"{first}\n{second}\n")
    with pytest.raises(FileFormatError, match="images.txt: line 2: got '2 1 0.*an empty line for"):
        read_colmap(tmp_path, missing_images="none")


@pytest.mark.parametrize("keypoints", ["", "1.5 2.5 -1 3 4e1 17", "None", "  # no keypoints"])
def test_keypoints_of_any_form_are_skipped(tmp_path, keypoints):
    """Oracle: the readers of COLMAP's own scripts, which split the line and use none of it here."""
    write_text(tmp_path)
    first, second = (f"{n} 1 0 0 0 0 0 1 7 {n}.png" for n in (1, 2))
    (tmp_path / "images.txt").write_text(f"{first}\n{keypoints}\n{second}\n")
    cameras = read_colmap(tmp_path, missing_images="none").cameras
    assert [camera.name for camera in cameras] == ["1.png", "2.png"]


def test_an_empty_text_file_of_points_holds_none(tmp_path):
    (write_text(tmp_path / "text") / "points3D.txt").write_bytes(b"")
    data = read_dataset(tmp_path / "text", missing_images="none")
    assert data.points.shape == (0, 3) and data.colors.shape == (0, 3)


@pytest.mark.parametrize("write", [write_binary, write_text])
def test_points_that_are_not_wanted_are_not_read(tmp_path, write):
    model = write(tmp_path)
    (next(model.glob("points3D.*"))).write_bytes(b"no points")
    with pytest.raises(FileFormatError, match="points3D"):
        read_dataset(model, missing_images="none")
    data = read_dataset(model, missing_images="none", points=False)
    assert len(data) == 3 and data.points is None and data.colors is None


@pytest.mark.door
def test_missing_images_are_listed(tmp_path):
    write_binary(tmp_path / "sparse/0")
    with pytest.raises(
        FileFormatError, match=r"3 of 3 images are missing: .*a\.png.*c\.png; put them there"
    ):
        read_colmap(tmp_path)
    # Two ways out: where they are, and what they are called.
    (tmp_path / "images").mkdir()
    Image.new("RGB", (8, 6)).save(tmp_path / "images" / "a.jpg")
    message = r"c\.png; a\.jpg is there; put them there, or name their folder: .*--images FOLDER"
    with pytest.raises(FileFormatError, match=message):
        read_colmap(tmp_path)


def test_smaller_images_in_another_folder_resize_the_cameras_when_asked(tmp_path):
    write_binary(tmp_path / "sparse/0")
    pictures(tmp_path / "images_2", (4, 3))
    with pytest.raises(FileFormatError, match=r"is 4 x 3, but its camera is 8 x 6"):
        read_dataset(tmp_path, images="images_2")
    data = read_dataset(tmp_path, images="images_2", resize_cameras=True)
    # u' = u s exactly with pixel centres at +0.5: no half-pixel terms.
    assert data.cameras[2].K.tolist() == [[5, 0, 1.75], [0, 5.5, 1.625], [0, 0, 1]]


@pytest.mark.parametrize("where", [".", "sparse", "sparse/0", "colmap/sparse/0"])
def test_pictures_by_scale_are_those_beside_the_model_from_wherever_it_is_read(
    tmp_path, monkeypatch, where
):
    model = write_binary(tmp_path / "data" / where)
    pictures(tmp_path / "data" / "images_2", (4, 3))
    pictures(tmp_path / "other" / "images_2", (4, 3))  # of another scene, with the same names
    monkeypatch.chdir(tmp_path / "other")
    for path in (tmp_path / "data", model):
        data = read_dataset(path, scale=2)
        assert {image.relative_to(tmp_path).parts[0] for image in data.image_paths} == {"data"}
        assert data.cameras[2].K.tolist() == [[5, 0, 1.75], [0, 5.5, 1.625], [0, 0, 1]]


@pytest.mark.parametrize("where", [".", "sparse", "sparse/0", "colmap/sparse/0"])
def test_the_model_and_its_images_are_found_in_the_usual_places(tmp_path, monkeypatch, where):
    model = write_binary(tmp_path / where)
    pictures(tmp_path / "images")
    assert len(read_dataset(tmp_path)) == 3
    if where != ".":
        assert len(read_dataset(model)) == 3, "the model's own folder, images above it"
        monkeypatch.chdir(model)
        assert len(read_dataset(".")) == 3, "from inside it"


def test_a_folder_that_is_both_kinds_or_none_is_not_guessed(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"neither a transforms.json nor a COLMAP model"):
        read_dataset(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        read_dataset(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match="no COLMAP model"):
        read_dataset(tmp_path, format="colmap")
    write_binary(tmp_path / "sparse/0")
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(
        FileFormatError, match=r"both a transforms.json and a COLMAP model.*format="
    ):
        read_dataset(tmp_path)
    assert len(read_dataset(tmp_path, format="colmap", missing_images="none")) == 3
    with pytest.raises(FileFormatError, match="frames"):
        read_dataset(tmp_path, format="transforms")
    with pytest.raises(ValueError, match="format: got 'nerf'"):
        read_dataset(tmp_path, format="nerf")


@pytest.mark.door
@pytest.mark.parametrize("write", [write_binary, write_text])
def test_an_image_that_stands_twice_is_refused(tmp_path, write):
    images = poses()
    images[2] = (*images[2][:4], images[0][4], 0)
    write(tmp_path, images=images)
    with pytest.raises(FileFormatError, match=r"image 'b/second view.png' stands twice"):
        read_dataset(tmp_path, missing_images="none")


@pytest.mark.door
@pytest.mark.parametrize("write", [write_binary, write_text])
def test_a_camera_that_stands_twice_is_refused(tmp_path, write):
    write(tmp_path, cameras=[*CAMERAS, CAMERAS[0]])
    with pytest.raises(FileFormatError, match="camera 7 stands twice"):
        read_dataset(tmp_path, missing_images="none")


@pytest.mark.parametrize("write", [write_binary, write_text])
def test_a_model_with_more_images_beside_the_one_that_is_read_is_named(tmp_path, write):
    for number, count in ((0, 2), (1, 3), (2, 1)):
        write(tmp_path / "sparse" / str(number), images=poses(count))
    pictures(tmp_path / "images")
    (tmp_path / "sparse" / "10").mkdir()  # without a model
    (tmp_path / "sparse" / "notes").mkdir()
    larger = (
        r"0: is read, with 2 images; .*1 has 3, and may be the better model: name it, with .*images"
    )
    with pytest.warns(InputWarning, match=larger):
        assert len(read_dataset(tmp_path).cameras) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        named = read_dataset(tmp_path / "sparse" / "1", images=tmp_path / "images")
        assert len(named.cameras) == 3
        read_dataset(tmp_path / "sparse" / "0")  # named: it is meant
        (
            tmp_path / "sparse" / "1" / f"images{'.bin' if write is write_binary else '.txt'}"
        ).unlink()
        assert len(read_dataset(tmp_path).cameras) == 2


def test_masks_beside_the_images_have_their_names_with_or_without_suffix(tmp_path):
    write_text(tmp_path / "sparse" / "0")
    pictures(tmp_path / "images")
    names = sorted(name for *_, name, _ in poses())
    pictures(tmp_path / "masks", images=[(0, 0, 0, 0, f"{names[0]}.png", 0)])
    assert read_colmap(tmp_path).mask_paths == [
        tmp_path / "masks" / f"{names[0]}.png", *[None] * (len(names) - 1)
    ]  # fmt: skip
