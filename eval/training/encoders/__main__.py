"""Rebuild the bundled encoders from nothing: python -m training, from the folder eval/."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    help="Recipes of the bundled encoders. Run from eval/: python -m training.encoders all",
    no_args_is_help=True,
)

Data = Annotated[
    Path, typer.Option(help="Folder of the pictures; rendered where they are missing.")
]
Out = Annotated[Path, typer.Option(help="Folder of checkpoints; training goes on from them.")]
Weights = Annotated[
    Path | None, typer.Option(help="Folder that gets the weights; else the package's.")
]
Threads = Annotated[int, typer.Option(min=1, help="Of training and rendering.")]

DATA, OUT = Path("../runs/encoders/data"), Path("../runs/encoders")
NAMES = ("clip-small", "clip-parts", "dino-small", "perceptual-small")


@app.command()
def data(folder: Data = DATA, threads: Threads = 2) -> None:
    """Render the pictures (an hour and a half on two cores)."""
    from training.worlds import part_pictures
    from training.worlds.data import SPLITS, make

    for name in SPLITS:
        make(folder, name, threads)
    for name in part_pictures.PART_SPLITS:
        part_pictures.make(folder, name, threads)


@app.command()
def train(name: str, data: Data = DATA, out: Out = OUT, threads: Threads = 2) -> None:
    """Train one encoder: clip-small, clip-parts, dino-small or perceptual-small."""
    import torch

    torch.set_num_threads(threads)
    _recipe(name).train(data, out)


@app.command()
def export(name: str, out: Out = OUT, weights: Weights = None) -> None:
    """Write a trained encoder's weights in half precision, as the package carries them."""
    import shutil

    import torch
    from safetensors.torch import save_file

    state = torch.load(out / f"{name}.pt", weights_only=True)
    if name == "dino-small":  # the teacher is the better one, as in DINO
        prefix = "net."
        net = {
            k.removeprefix(prefix): v for k, v in state["teacher"].items() if k.startswith(prefix)
        }
    else:
        net = state["model"]
    weights = weights or _package_folder(name)
    weights.mkdir(parents=True, exist_ok=True)
    half = {k: v.half().contiguous() if v.is_floating_point() else v for k, v in net.items()}
    save_file(half, weights / f"{name}.safetensors")
    (weights / f"{name}.safetensors").chmod(
        0o644
    )  # safetensors makes files that only their owner can read
    (weights / f"{name}.md").unlink(missing_ok=True)  # a card of other weights would refuse these
    words = out / f"{name}.tokenizer.json"
    if words.exists():
        shutil.copyfile(words, weights / words.name)
    typer.echo(weights / f"{name}.safetensors")


@app.command("all")
def everything(
    data: Data = DATA, out: Out = OUT, weights: Weights = None, threads: Threads = 2
) -> None:
    """All of it: pictures, training, weights."""
    for name in NAMES:
        train(name, data, out, threads)
        export(name, out, weights)


def _bundled(name: str) -> Any:
    """Module that loads a bundled encoder."""
    import importlib

    small = name == "dino-small"
    return importlib.import_module(
        "attnwarp_eval.encoders.dino_small" if small else "attnwarp.encoders.bundled"
    )


def _package_folder(name: str) -> Path:
    folder: Path = _bundled(name).WEIGHTS
    return folder


def _recipe(name: str) -> Any:
    import importlib

    if name not in NAMES:
        raise typer.BadParameter(f"got {name!r}, expected one of {', '.join(NAMES)}")
    modules = {
        "clip-small": "clip",
        "clip-parts": "clip_parts",
        "dino-small": "dino",
        "perceptual-small": "perceptual",
    }
    return importlib.import_module(f"training.encoders.{modules[name]}")


if __name__ == "__main__":
    app()
