"""Draw the pictures of docs/inspecting.md with the commands that the page names.

python scripts/pictures_of_inspect.py docs/pictures
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path

COMMANDS = {
    "inspect.png": "bear --size 256 --variant released --view yaw030 --pixel 203,152",
    "inspect-cell.png": "bear --size 256 --view yaw030 --layer 32x32 --color rules --pixel 120,200",
    "inspect-splats.png": "spheres --size 256 --view yaw060 --color incidence --splats",
}
"""File -> arguments of attnwarp-eval inspect."""


def draw(folder: Path, name: str) -> None:
    """Make one picture, reduced to the width of a page."""
    import cv2

    path = folder / name
    command = [sys.executable, "-m", "attnwarp_eval.cli.main", "inspect"]
    subprocess.run([*command, *shlex.split(COMMANDS[name]), "--screenshot", path], check=True)
    picture = cv2.imread(str(path))
    height = round(1200 * picture.shape[0] / picture.shape[1])
    small = cv2.resize(picture, (1200, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=list(COMMANDS))
    options = parser.parse_args()
    for each in options.names:
        draw(options.folder, each)
