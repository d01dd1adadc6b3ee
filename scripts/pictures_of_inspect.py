"""Draw the pictures of docs/measuring/inspecting.md with the commands that the page names.

python scripts/pictures_of_inspect.py docs/pictures
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

COMMANDS = {
    "inspect.jpg": "bear --size 256 --variant released --view yaw030 --pixel 203,152",
    "inspect-cell.jpg": "bear --size 256 --view yaw030 --layer 32x32 --color rules --pixel 120,200",
    "inspect-splats.jpg": "spheres --size 256 --view yaw060 --color incidence --splats",
}
"""File -> arguments of attnwarp-eval inspect."""

WIDTH = 1200
"""Width of the pictures, in pixels."""


def draw(folder: Path, name: str) -> None:
    """Make one picture, reduced to the width of a page."""
    command = [sys.executable, "-m", "attnwarp_eval", "inspect"]
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "window.png"
        subprocess.run([*command, *shlex.split(COMMANDS[name]), "--screenshot", path], check=True)
        reduce(path, folder / name)


def reduce(path: Path, out: Path) -> None:
    """Write a picture as a JPEG of the width of a page."""
    import cv2

    picture = cv2.imread(str(path))
    if picture is None:
        raise SystemExit(f"{path}: is no picture, expected the one of --screenshot")
    height = round(WIDTH * picture.shape[0] / picture.shape[1])
    small = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(out), small, [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=list(COMMANDS))
    options = parser.parse_args()
    for each in options.names:
        draw(options.folder, each)
