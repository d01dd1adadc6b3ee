"""Rebuild the bundled editors from nothing: python -m training.editors, from the folder eval/."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="Recipe of the bundled editors. Stages go on where they were stopped.",
    no_args_is_help=True,
)

CACHE = Path.home() / ".cache" / "attnwarp" / "training" / "editing"
WEIGHTS = Path(__file__).parents[3] / "attnwarp" / "editing" / "weights"

Out = Annotated[Path, typer.Option(help="Folder of checkpoints.")]
Data = Annotated[
    Path, typer.Option(help="Folder of the pictures; rendered where they are missing.")
]
Cards = Annotated[Path, typer.Option(help="Folder of the editors.")]
Threads = Annotated[int, typer.Option(min=1, help="Of training.")]


@app.command()
def data(folder: Data = CACHE / "data", workers: int = 2) -> None:
    """Render the pictures (about an hour on two cores, 9 GB)."""
    from training.worlds.editing_pairs import PAIR_SPLITS, make_pairs

    for name in PAIR_SPLITS:
        make_pairs(folder, name, workers)


@app.command()
def train(
    stage: str, data: Data = CACHE / "data", out: Out = CACHE, threads: Threads = 1,
    device: Annotated[str, typer.Option(help="Of torch: cpu or cuda.")] = "cpu",
) -> None:  # fmt: skip
    """Train a stage: plain, drawn. On a GPU each takes minutes, on a CPU days."""
    import torch

    if device not in ("cpu", "cuda"):
        raise typer.BadParameter(f"got {device!r}, expected cpu or cuda", param_hint="--device")
    if device == "cuda" and not torch.cuda.is_available():
        raise typer.BadParameter("torch finds no GPU here; use cpu", param_hint="--device")
    from training.editors.recipe import train_stage

    train_stage(checked(stage), data, out, threads=threads, device=device)


def checked(stage: str) -> str:
    """The stage's name. BadParameter: there is none of that name."""
    from training.editors.recipe import STAGES

    if stage not in STAGES:
        raise typer.BadParameter(
            f"got {stage!r}, expected one of {', '.join(STAGES)}", param_hint="STAGE"
        )
    return stage


@app.command()
def export(stage: str, name: str, out: Out = CACHE, weights: Cards = WEIGHTS) -> None:
    """Write a stage's editor, as far as it has come, into the package under a name such as small-plain."""
    from training.editors.export import export_editor

    typer.echo(export_editor(checked(stage), out, weights / name))


if __name__ == "__main__":
    app()
