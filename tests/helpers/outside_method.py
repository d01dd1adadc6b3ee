"""A method of another program, for studies: views go to a folder, and results come from there.

The first run writes each scene and says where its result is missing. Run the other program on every
such folder, then the study again:

    transforms.json, images/, splats.ply, instruction.txt     what it gets
    edited/NAME.png, edited.ply, seconds.txt                  what it leaves
"""

from pathlib import Path

import numpy as np

from attnwarp.digest import digest
from attnwarp.errors import InputError
from attnwarp.io import Dataset, read_image, read_ply, write_ply, write_transforms
from attnwarp_eval.files import write_picture
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, EditedScene, Method


def settings(preset, fields, seed):
    return {"root": fields["root"], "seed": seed}


def run(job):
    pixels = [np.rint(255 * np.asarray(image)).astype(np.uint8) for image in job.images]
    place = Path(job.settings["root"]) / digest(job.instruction, job.settings["seed"], *pixels)[:12]
    names = [f"{k:03d}" for k in range(len(pixels))]  # 000 is the source
    (place / "images").mkdir(parents=True, exist_ok=True)
    paths = [place / "images" / f"{name}.png" for name in names]
    for path, picture in zip(paths, pixels, strict=True):
        write_picture(path, picture)
    write_transforms(place, Dataset(list(job.cameras), paths))
    write_ply(place / "splats.ply", job.gaussians)
    (place / "instruction.txt").write_text(job.instruction)
    if not (place / "edited.ply").is_file():
        raise InputError(f"{place}: has no edited.ply; run the method on it, then the study again")
    edited = {
        k: read_image(place / "edited" / f"{name}.png")[..., :3]
        for k, name in enumerate(names)
        if (place / "edited" / f"{name}.png").is_file()
    }
    seconds = float((place / "seconds.txt").read_text())
    return EditedScene(read_ply(place / "edited.ply"), edited, {"edit": seconds}, counters={})


EDITING_METHODS["outside"] = Method(settings, run)
