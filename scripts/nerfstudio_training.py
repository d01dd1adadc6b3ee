"""Train nerfstudio's nerfacto for some iterations on a data set that we exported, on the CPU.

Run it by the Python of an environment with nerfstudio, which wants older packages than ours:

    attnwarp-eval scenes export spheres DATA --views 16 --size 64
    NERFSTUDIO/bin/python scripts/nerfstudio_training.py DATA --out report.md

The exit code is 1 if a split or a ray differs from transforms.json, or if the loss does not fall.
"""

from __future__ import annotations

import argparse
import copy
import importlib.metadata
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.configs.base_config import LoggingConfig
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

SPLITS = ("train", "val", "test")

ANGLE = 1e-5
"""Largest difference of unit directions: nerfstudio's rotations are float32."""


def parsed(data: Path, split: str) -> Any:
    """Parse one split with nerfstudio's dataparser."""
    return NerfstudioDataParserConfig(data=data).setup().get_dataparser_outputs(split)


def ray_gap(data: Path, split: str) -> tuple[int, float]:
    """Number of images of a split, and the largest difference of nerfstudio's rays from the
    directions that transforms.json means: through (x + 0.5, y + 0.5), in OpenGL's axes.
    """
    document = json.loads((data / "transforms.json").read_text())
    frames = {frame["file_path"]: frame for frame in document["frames"]}
    outputs = parsed(data, split)
    names = [str(Path(name).relative_to(data)) for name in outputs.image_filenames]
    if sorted(names) != sorted(document[f"{split}_filenames"]):
        raise SystemExit(f"{split}: nerfstudio reads {names}, expected the list of the file")
    back = outputs.dataparser_transform[:, :3].numpy().astype(np.float64).T
    gap = 0.0
    for k, name in enumerate(names):
        frame = {**document, **frames[name]}
        rotation = np.array(frame["transform_matrix"])[:3, :3]
        y, x = np.mgrid[: frame["h"], : frame["w"]] + 0.5
        local = np.stack(
            [
                (x - frame["cx"]) / frame["fl_x"],
                (frame["cy"] - y) / frame["fl_y"],
                -np.ones_like(x),
            ],
            axis=-1,
        )
        expected = local @ rotation.T
        expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
        rays = outputs.cameras.generate_rays(camera_indices=k).directions.numpy()
        gap = max(gap, float(np.abs(rays @ back.T - expected).max()))
    return len(names), gap


def without_val(data: Path) -> str:
    """nerfstudio's error for the same data set without a list for "val"."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(data, folder, dirs_exist_ok=True)
        path = Path(folder) / "transforms.json"
        document = json.loads(path.read_text())
        del document["val_filenames"]
        path.write_text(json.dumps(document))
        try:
            parsed(Path(folder), "val")
        except Exception as error:  # whatever nerfstudio raises
            return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
    return "none"


def train(data: Path, iterations: int) -> tuple[list[float], float]:
    """The loss at each iteration of nerfacto, and that on rays of the val split at the end."""
    config = copy.deepcopy(method_configs["nerfacto"])
    config.machine.device_type = "cpu"
    config.mixed_precision = False
    config.max_num_iterations = iterations
    config.vis = "tensorboard"
    config.logging = LoggingConfig()
    manager = config.pipeline.datamanager
    manager.dataparser = NerfstudioDataParserConfig(data=data)
    manager.train_num_rays_per_batch = manager.eval_num_rays_per_batch = 256
    config.pipeline.model.implementation = "torch"
    with tempfile.TemporaryDirectory() as folder:
        config.output_dir = Path(folder)
        config.set_timestamp()
        torch.manual_seed(0)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        losses = [float(trainer.train_iteration(step)[0]) for step in range(iterations)]
        trainer.pipeline.eval()
        _, held_out, _ = trainer.pipeline.get_eval_loss_dict(iterations)
    return losses, float(sum(held_out.values()))


def main() -> int:
    """Compare, train and write the report; the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with transforms.json and its pictures")
    parser.add_argument("--iterations", type=int, default=20, help="of training (20)")
    parser.add_argument("--out", type=Path, help="write the report here instead of printing it")
    options = parser.parse_args()
    data = options.data.resolve()
    splits = {split: ray_gap(data, split) for split in SPLITS}
    losses, held_out = train(data, options.iterations)
    quarter = max(1, len(losses) // 4)
    first, last = np.mean(losses[:quarter]), np.mean(losses[-quarter:])
    is_right = all(gap <= ANGLE for _, gap in splits.values()) and last < first
    versions = ", ".join(
        f"{name} {importlib.metadata.version(name)}" for name in ("nerfstudio", "torch", "numpy")
    )
    lines = [
        "# nerfstudio's training on our export",
        "",
        f"nerfacto, torch implementation, on the CPU: {options.iterations} iterations of 256 rays."
        f" {versions}.",
        "",
        f"**{'It trains' if is_right else 'IT DOES NOT TRAIN'}:** mean loss {first:.4f} over the"
        f" first {quarter} iterations, {last:.4f} over the last; {held_out:.4f} on rays of `val`.",
        "",
        "| split | pictures | largest difference of unit ray directions from transforms.json |",
        "|---|---|---|",
        *(f"| {split} | {count} | {gap:.1e} |" for split, (count, gap) in splits.items()),
        "",
        f"The same data without `val_filenames`: `{without_val(data)}`.",
    ]
    text = "\n".join(lines) + "\n"
    if options.out:
        options.out.write_text(text)
    else:
        sys.stdout.write(text)
    return int(not is_right)


if __name__ == "__main__":
    sys.exit(main())
