"""Make the bundled captures that `attnwarp edit NAME` edits: a scene's export, with splats fitted
to it.

    python -m scripts.bundle_scenes [NAME...]

Each archive holds transforms.json, images, exact masks and splats.ply. Pictures are JPEG, and the
splats' values are rounded to half floats, whose zeros compress;
tests/attnwarp/cli/test_bundled_scene.py bounds the loss.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZIP_LZMA, ZipFile, ZipInfo

import numpy as np
from PIL import Image
from plyfile import PlyData

from attnwarp.cli.bundled_scene import FOLDER, HOW, bundled

JPEG_QUALITY = 98


def made(name: str, folder: Path) -> Path:
    """Run the commands behind a capture in a folder; return the exported one."""
    for step in HOW:
        program, *arguments = step.format(name=name).split()
        module = program.replace("-", "_")
        subprocess.run([sys.executable, "-m", module, *arguments], cwd=folder, check=True)
    return folder / name


def bundle(name: str) -> None:
    """Write a capture's archive."""
    with TemporaryDirectory() as place:
        capture = made(name, Path(place))
        round_splats(Path(place, "fit", "splats.ply"), capture / "splats.ply")
        pack(capture, FOLDER / f"{name}.zip")


def pack(capture: Path, out: Path) -> None:
    """Write a capture as an archive, its pictures as JPEG, transforms.json last."""
    for path in capture.glob("images/*.png"):
        picture = path.with_suffix(".jpg")
        Image.open(path).save(picture, quality=JPEG_QUALITY, subsampling=0, optimize=True)
    cameras = capture / "transforms.json"
    cameras.write_text(cameras.read_text().replace(".png", ".jpg"))
    with ZipFile(out, "w", ZIP_LZMA) as archive:
        for pattern in ("*.ply", "images/*.jpg", "masks/*/*.png", cameras.name):
            for file in sorted(capture.glob(pattern)):
                # Without a date, so that the same files make the same archive.
                entry = ZipInfo(file.relative_to(capture).as_posix())
                archive.writestr(entry, file.read_bytes(), ZIP_LZMA)


def round_splats(path: Path, out: Path) -> None:
    """Round the values of a PLY to half floats."""
    ply = PlyData.read(path)
    for property in ply["vertex"].properties:
        values = ply["vertex"][property.name]
        ply["vertex"][property.name] = values.astype(np.float16).astype(values.dtype)
    ply.write(out)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", nargs="*", default=bundled(), help="scenes; all bundled ones")
    for name in parser.parse_args().name:
        bundle(name)


if __name__ == "__main__":
    main()
