"""Packages as their registries have them, made here; read by the program's own reader."""

import gzip
import io
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from attnwarp_eval.scene.meshes import read_mesh
from scripts.other_meshes import OF_WHEEL

pytestmark = pytest.mark.scripts

CORNERS = [[0, 0, 0], [1.5, 0, 0], [0, -2e-1, 0], [0, 0, 3]]
CELLS = [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]
MODULE = f"exports.positions={CORNERS};\nexports.cells = {CELLS}\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""


def packed(path: Path, name: str, data: bytes) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        entry = tarfile.TarInfo(f"package/{name}")
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    return path


def test_meshes_of_packages_become_files(tmp_path):
    packages = [
        packed(tmp_path / "bunny.tgz", "index.js", MODULE.encode()),
        packed(tmp_path / "teapot.tgz", "teapot.js", MODULE.replace(" ", "").encode()),
        packed(
            tmp_path / "dragon.tgz", "models/dragon_vrip_res3.ply.gz", gzip.compress(PLY.encode())
        ),
        tmp_path / "pybullet.whl",
    ]
    with zipfile.ZipFile(packages[3], "w") as wheel:
        for name in OF_WHEEL:
            wheel.writestr(f"pybullet_data/{name}.obj", OBJ)
    out = tmp_path / "meshes"
    command = [sys.executable, "-m", "scripts.other_meshes", out, *packages]
    subprocess.run(list(map(str, command)), check=True, cwd=Path(__file__).parents[2])
    assert len(list(out.iterdir())) == 3 + len(OF_WHEEL)
    for name in ("bunny.glb", "teapot.glb"):
        mesh = read_mesh(out / name)
        assert np.allclose(mesh.vertices, CORNERS, atol=1e-7) and np.array_equal(mesh.faces, CELLS)
    assert len(read_mesh(out / "dragon.ply").faces) == len(read_mesh(out / "duck.glb").faces) == 1
