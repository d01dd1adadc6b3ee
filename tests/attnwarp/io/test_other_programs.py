"""The table of docs/method/files.md, row by row: others with our files, we with theirs.

Each row has a check here, which runs where its program is installed; in CI, a missing one is a failure.
"""

import ctypes
import importlib
import importlib.metadata
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from attnwarp import Gaussians
from attnwarp.io import read_colmap, read_ply, write_ply

PAGE = Path(__file__).parents[3] / "docs/method/files.md"


def splats():
    random = torch.Generator().manual_seed(0)
    return Gaussians(
        "3d",
        torch.randn(20, 3, generator=random),
        torch.randn(20, 4, generator=random),
        0.1 + torch.rand(20, 3, generator=random),
        torch.rand(20, generator=random),
        torch.randn(20, 16, 3, generator=random),
        origin=np.array([0.5, -1.0, 2.0]),
    )


def our_centres(g):
    return g.world_means().astype(np.float32)


def skip_without(program):
    """End a test whose program is missing: in CI, which installs all of them, as a failure."""
    (pytest.fail if os.environ.get("CI") else pytest.skip)(
        f"{program} is not installed; scripts/venv.sh installs all that tests compare with"
    )


def library(name):
    try:
        return importlib.import_module(name)
    except ImportError:
        skip_without(name)


def open3d():
    # A bare machine lacks the libusb that Open3D links.
    path = str(library("libusb_package").get_library_path())
    ctypes.CDLL(path, mode=ctypes.RTLD_GLOBAL)
    return library("open3d")


def plyfile_reads_every_property(tmp_path):
    plyfile = library("plyfile")
    write_ply(tmp_path / "a.ply", splats())
    vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[c] for c in "xyz"], 1), our_centres(splats()))
    assert len(vertex.properties) == 62  # of the original trainer


def open3d_reads_the_centres(tmp_path):
    write_ply(tmp_path / "a.ply", splats())
    cloud = open3d().io.read_point_cloud(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(np.asarray(cloud.points), our_centres(splats()))


def trimesh_reads_the_centres(tmp_path):
    trimesh = library("trimesh")
    write_ply(tmp_path / "a.ply", splats())
    cloud = trimesh.load(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(np.asarray(cloud.vertices), our_centres(splats()))


def we_read_what_gsplat_exports(tmp_path):
    exporter = library("gsplat.exporter")
    g = splats()
    logits = torch.logit(g.opacities.double()).float()
    exporter.export_splats(
        g.means, g.scales.log(), g.quats, logits, g.sh[:, :1], g.sh[:, 1:],
        save_to=str(tmp_path / "a.ply"),
    )  # fmt: skip
    back = read_ply(tmp_path / "a.ply")
    assert back.kind == "3d" and torch.equal(back.sh, g.sh) and torch.equal(back.means, g.means)
    # float32 logarithms on both ways.
    torch.testing.assert_close(back.scales, g.scales, rtol=2e-6, atol=0)
    torch.testing.assert_close(back.opacities, g.opacities, rtol=2e-6, atol=0)


def we_read_what_pycolmap_writes(tmp_path):
    pycolmap = library("pycolmap")
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=64, height=48, params=[50, 52, 31, 25]
    )
    reconstruction.add_camera_with_trivial_rig(camera)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0.1, 0.1, 0.7, 0.7]), np.array([0.1, -0.2, 3]))
    image = pycolmap.Image(image_id=1, camera_id=1, name="a.png")
    reconstruction.add_image_with_trivial_frame(image, pose)
    reconstruction.add_point3D(np.array([0.5, 0.25, -1.0]), pycolmap.Track(), np.array([9, 8, 7]))
    for write, name in ((reconstruction.write_binary, "bin"), (reconstruction.write_text, "txt")):
        (tmp_path / name).mkdir()
        write(str(tmp_path / name))
        data = read_colmap(tmp_path / name, missing_images="none")
        theirs = reconstruction.image(1).project_point(np.array([0.2, 0.1, 0.4]))
        np.testing.assert_allclose(data.cameras[0].project([0.2, 0.1, 0.4])[0], theirs, atol=1e-9)
        assert data.points.tolist() == [[0.5, 0.25, -1.0]] and data.colors.tolist() == [[9, 8, 7]]


CHECKS = {
    ("plyfile", "PLY from us", "all properties"): plyfile_reads_every_property,
    ("Open3D", "PLY from us", "the centres, as a point cloud"): open3d_reads_the_centres,
    ("trimesh", "PLY from us", "the centres, as a point cloud"): trimesh_reads_the_centres,
    ("gsplat", "its exporter's PLY to us", "read"): we_read_what_gsplat_exports,
    ("pycolmap", "its models, binary and text, to us", "read"): we_read_what_pycolmap_writes,
}


def table():
    """(program, version, file, result) of each row."""
    text = PAGE.read_text()
    rows = re.findall(r"^\| ([^|]+) \| ([\d.]+) \| ([^|]+) \| ([^|]+) \|$", text, re.MULTILINE)
    return [tuple(cell.strip().replace("`", "") for cell in row) for row in rows]


def test_the_table_of_the_docs_has_the_rows_that_are_checked():
    assert [(program, what, result) for program, _, what, result in table()] == list(CHECKS)


@pytest.mark.parametrize("row", CHECKS, ids=lambda row: f"{row[0]}: {row[1]}")
def test_the_table_of_the_docs_is_true(tmp_path, monkeypatch, row):
    # Or gsplat might start to build for CUDA.
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "none"))
    CHECKS[row](tmp_path)


@pytest.mark.parametrize("program", dict.fromkeys(program for program, _, _ in CHECKS))
def test_the_versions_in_the_docs_are_no_newer_than_what_was_tried(program):
    packages = importlib.metadata.packages_distributions().get(program.lower(), ())
    if not packages:
        skip_without(program)
    version = importlib.metadata.version(packages[0])  # Open3D comes as open3d-cpu, too
    stated = {v for name, v, _, _ in table() if name == program}
    assert len(stated) == 1
    number = lambda text: [int(part) for part in text.split(".")[:3]]  # noqa: E731
    assert number(stated.pop()) <= number(version), "tried here with an older one: correct the page"
