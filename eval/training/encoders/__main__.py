"""Rebuild the bundled encoders from nothing: python -m training, from the folder eval/."""

from __future__ import annotations

import json
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
    Path | None, typer.Option(help="Folder that gets weights and cards; else the package's.")
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


@app.command()
def assess(
    name: str, data: Data = DATA, out: Out = OUT, weights: Weights = None, threads: Threads = 2
) -> None:
    """Measure an encoder on unseen data, and write its card; the checkpoint, if there is
    one, says how long training took.
    """
    import torch

    import training.assess.figures
    from training.assess.parts import part_figures
    from training.encoders.cards import card
    from training.worlds import part_pictures

    torch.set_num_threads(threads)
    weights = weights or _package_folder(name)
    encoder: Any = _bundled(name).load(name, weights)
    sets = training.assess.figures.test_sets(data)

    def figures() -> list[dict[str, Any]]:
        if name.startswith("clip"):
            results = training.assess.figures.clip_figures(encoder, sets)
        if name == "clip-parts":
            results += part_figures(encoder, part_pictures.load(data, "parts-test"))
        if name == "dino-small":
            results = training.assess.figures.dino_figures(encoder, sets)
        if name == "perceptual-small":
            results = training.assess.figures.perceptual_figures(encoder, sets["test"].images)
        return [f.to_dict() for f in results]

    trained = figures()
    facts = _facts(name, encoder, out) | {"seconds": _seconds(encoder), "threads": threads}
    torch.manual_seed(0)
    encoder.net = (
        type(encoder.net)(encoder.tokenizer.get_vocab_size())
        if name.startswith("clip")
        else type(encoder.net)()
    )
    encoder.net.eval().requires_grad_(False)
    control = figures()
    for f in trained:
        typer.echo(f"{100 * f['value']:6.1f} %  {f['what']}")
    typer.echo(f"{facts['seconds']:.3f} s for 32 pictures on {threads} threads")
    files = sorted(
        p
        for p in weights.glob(f"{name}.*")
        if p.suffix in (".safetensors", ".json") and "figures" not in p.name
    )
    (weights / f"{name}.md").write_text(card(name, trained, control, facts, files))
    (weights / f"{name}.figures.json").write_text(
        json.dumps({"trained": trained, "random": control}, indent=1) + "\n"
    )


@app.command("all")
def everything(
    data: Data = DATA, out: Out = OUT, weights: Weights = None, threads: Threads = 2
) -> None:
    """All of it: pictures, training, weights, cards."""
    for name in NAMES:
        train(name, data, out, threads)
        export(name, out, weights)
        assess(name, data, out, weights, threads)


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


def _seconds(encoder: Any, rounds: int = 7) -> float:
    """Median seconds for 32 pictures of 128 x 128 px (pairs, for a distance)."""
    import statistics
    import time

    import numpy as np

    pictures = list(np.random.default_rng(0).uniform(size=(32, 128, 128, 3)).astype(np.float32))
    taken = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        encoder.images(pictures) if hasattr(encoder, "images") else encoder.distance(
            pictures, pictures[::-1]
        )
        taken.append(time.perf_counter() - start)
    return statistics.median(taken[1:])


def _facts(name: str, encoder: Any, out: Path) -> dict[str, Any]:
    import importlib

    import torch

    from attnwarp_eval.drawn.assemblies import KINDS
    from attnwarp_eval.drawn.worlds import COLORS, FINISHES, GROUNDS, OBJECTS, TIMES
    from training.common import minutes
    from training.encoders.perceptual import TRAIN_PHOTOS
    from training.worlds import part_pictures
    from training.worlds.data import SPLITS

    def millions(net: Any) -> float:
        return sum(p.numel() for p in net.parameters()) / 1e6

    net, recipe = encoder.net, _recipe(name)
    cast = 6 * SPLITS["train"].worlds + 4 * (
        SPLITS["train-moved"].worlds + SPLITS["train-shapes"].worlds
    )
    facts = {
        "dim": encoder.about.dim, "size": millions(net), "torch": torch.__version__.partition("+")[0], "epochs": recipe.EPOCHS, "seed": recipe.SEED,
        "pictures": f"{cast} by ray casting", "objects": len(OBJECTS),
        "colors": len(COLORS), "finishes": len(FINISHES), "grounds": len(GROUNDS), "times": len(TIMES), "photos": "", "more": "",
    }  # fmt: skip
    checkpoints = [
        out / f"{name}.pt",
        *([out / "clip-small-naming.pt"] if name.startswith("clip") else []),
        *([out / "clip-small.pt"] if name == "clip-parts" else []),
    ]
    facts["minutes"] = minutes(*checkpoints)
    if name.startswith("clip"):
        facts |= {"vision": millions(net.vision) + millions(net.pool), "text": millions(net.text)}
        facts["pictures"] += f", {SPLITS['train-rendered'].worlds} by Mitsuba"
        facts["warm_epochs"] = importlib.import_module("training.encoders.naming").EPOCHS
    if name == "clip-parts":
        split = part_pictures.PART_SPLITS["parts-train"]
        count = (split.worlds - recipe.KEPT) * part_pictures.VIEWS * part_pictures.LOOKS
        facts["more"] = f", {count} of things with parts (`attnwarp_eval/drawn/assemblies.py`)"
        facts["kinds"], facts["part_words"] = len(KINDS), len(part_pictures.PARTS)
    if name == "perceptual-small":
        facts["pictures"] = f"{6 * SPLITS['train'].worlds // 7} by ray casting"
        facts["photos"] = (
            f"{len(TRAIN_PHOTOS)} photographs that scikit-image ships (four others are kept for the test); "
        )
    return facts


if __name__ == "__main__":
    app()
