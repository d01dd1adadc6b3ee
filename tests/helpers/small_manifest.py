"""A small run on captures: two exported scenes, random models in the published formats, a manifest."""

import shutil

import numpy as np
import yaml
from few_splats import few_splats
from tiny_editors import controlnet, pix2pix
from tiny_models import save_clip, save_dino

from attnwarp import Camera
from attnwarp.io import Dataset, write_ply, write_transforms
from attnwarp.render import render
from attnwarp_eval.files import write_picture
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.splats.export import export

SCENES = ("spheres", "bear")
VIEWS, SIZE = 6, 32

EDIT = {
    "instruction": "make the bear red",
    "controlnet": "a red bear",
    "source": "a bear",
    "target": "a red bear",
}

QUICK = {"steps": 2, "iterations": 4}

MANIFEST = {
    "format": 1,
    "title": "Two exported scenes",
    "size": SIZE,
    "captures": {
        name: {"data": f"captures/{name}", "edits": {"red": dict(EDIT)}} for name in SCENES
    },
    "fit": {"iterations": 60, "sh_degree": 0, "max_splats": 3000},
    "seeds": [0],
    "editors": {"pix2pix": "weights/pix2pix", "controlnet": "weights/base,weights/control"},
    "encoders": {"clip": "weights/clip", "dino": "weights/dino"},
    "variants": {
        "IGS2GS": {
            "method": "igs2gs", "editor": "pix2pix", "paper": [21.429, 0.267, 0.149, 0.627, 0.841],
            "options": {**QUICK, "every": 4},
        },
        "attention warp": {
            "editor": "pix2pix", "paper": [22.780, 0.264, 0.144, 0.727, 0.868], "seeds": [0, 1],
            "options": {**QUICK, "stages": 1, "views_per_stage": 3},
        },
        "GaussCtrl": {
            "method": "gaussctrl", "editor": "controlnet",
            "options": {**QUICK, "source_prompt": "{source}", "references": 2},
        },
        "1 stage": {
            "editor": "controlnet", "splats": "3d",
            "options": {**QUICK, "stages": 1, "views_per_stage": 2},
        },
    },
}  # fmt: skip


def write(folder):
    """The captures, ``manifest.yaml``, and random models in the formats of Stable Diffusion 1.5, a
    ControlNet, CLIP and DINOv2.
    """
    for name in SCENES:
        export(
            load_scene(name), folder / "captures" / name, views=VIEWS, size=SIZE, spp=2, points=800
        )
    weights = folder / "weights"
    pix2pix().save_pretrained(weights / "pix2pix")
    controlnet().save_pretrained(weights / "base")
    shutil.move(weights / "base" / "controlnet", weights / "control")
    (weights / "clip").mkdir()
    save_clip(weights / "clip")
    (weights / "dino").mkdir()
    save_dino(weights / "dino", registers=True)
    save(folder, MANIFEST)
    return folder


def save(folder, manifest, name="manifest.yaml"):
    path = folder / name
    path.write_text(yaml.safe_dump(manifest, sort_keys=False))
    return path


def write_capture(place, turn=0.0):
    """Three pictures that splats render, with these and a mask of each view."""
    for part in ("images", "masks"):
        (place / part).mkdir(parents=True)
    splats, cameras, paths = few_splats(), [], []
    for k, angle in enumerate((-0.4, 0.0, 0.4)):
        eye = [3 * np.sin(angle + turn), -3 * np.cos(angle + turn), 0.5]
        camera = Camera.look_at(eye, [0, 0, 0], width=SIZE, height=SIZE, fov_y=40)
        color = render(splats, camera).color.clamp(0, 1).numpy()
        paths.append(
            write_picture(place / "images" / f"{k}.png", np.rint(255 * color).astype(np.uint8))
        )
        write_picture(place / "masks" / f"{k}.png", np.full((SIZE, SIZE, 3), 255, np.uint8))
        cameras.append(camera)
    write_transforms(place / "transforms.json", Dataset(cameras, paths))
    write_ply(place / "scene.ply", splats)
