"""Rebuild the bundled editors from nothing: python -m training.edit, from the folder eval/."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="Recipe of the bundled editors. Stages go on where they were stopped.",
    no_args_is_help=True,
)

CACHE = Path.home() / ".cache" / "attnwarp" / "training" / "editing"
WEIGHTS = Path(__file__).parents[2] / "attnwarp" / "editing" / "weights"

REPORTS = Path(__file__).parents[2] / "reports" / "editor"

Out = Annotated[Path, typer.Option(help="Folder of checkpoints.")]
Data = Annotated[
    Path, typer.Option(help="Folder of the pictures; rendered where they are missing.")
]
Threads = Annotated[int, typer.Option(min=1, help="Of training.")]


@app.command()
def data(folder: Data = CACHE / "data", workers: int = 2) -> None:
    """Render the pictures (about an hour on two cores, 9 GB)."""
    from training.editing_pairs import PAIR_SPLITS, make_pairs

    for name in PAIR_SPLITS:
        make_pairs(folder, name, workers)


@app.command()
def train(
    stage: str, data: Data = CACHE / "data", out: Out = CACHE, threads: Threads = 1,
    device: Annotated[str, typer.Option(help="Of torch: cpu or cuda.")] = "cpu",
) -> None:  # fmt: skip
    """Train a stage: plain, drawn, features, control, depth. On a GPU each takes minutes, on a CPU days."""
    import torch

    if device not in ("cpu", "cuda"):
        raise typer.BadParameter(f"got {device!r}, expected cpu or cuda", param_hint="--device")
    if device == "cuda" and not torch.cuda.is_available():
        raise typer.BadParameter("torch finds no GPU here; use cpu", param_hint="--device")
    from training.depth_editor import DEPTH_STAGES, train_depth_stage
    from training.editor import train_stage

    trainer = train_depth_stage if checked(stage) in DEPTH_STAGES else train_stage
    trainer(stage, data, out, threads=threads, device=device)


def checked(stage: str) -> str:
    """The stage's name. BadParameter: there is none of that name."""
    from training.depth_editor import DEPTH_STAGES
    from training.editor import STAGES

    if stage not in (*STAGES, *DEPTH_STAGES):
        names = ", ".join([*STAGES, *DEPTH_STAGES])
        raise typer.BadParameter(f"got {stage!r}, expected one of {names}", param_hint="STAGE")
    return stage


@app.command()
def stages(out: Out = CACHE) -> None:
    """Print a table of the trained stages: steps, seconds and losses, from the logs of ``train``."""
    from training.depth_editor import DEPTH_STAGES
    from training.editor import STAGES
    from training.log import log_path, read_log, table

    logs = [log_path(out / f"{name}.pt") for name in (*STAGES, *DEPTH_STAGES)]
    logs = [path for path in logs if read_log(path)]
    if not logs:
        message = f"{out}: no log of an epoch, which training writes; train a stage first"
        raise typer.BadParameter(message, param_hint="--out")
    typer.echo(table(logs))


@app.command()
def export(
    stage: str, name: str, out: Out = CACHE, weights: Annotated[Path, typer.Option()] = WEIGHTS
) -> None:
    """Write a stage's editor, as far as it has come, into the package under a name such as small-plain."""
    from training.depth_editor import DEPTH_STAGES
    from training.editor_export import export_depth_editor, export_editor

    write = export_depth_editor if checked(stage) in DEPTH_STAGES else export_editor
    typer.echo(write(stage, out, weights / name))


@app.command()
def assess(
    stage: str, name: str, out: Out = CACHE, data: Data = CACHE / "data",
    weights: Annotated[Path, typer.Option()] = WEIGHTS,
    worlds: Annotated[int | None, typer.Option(help="Test worlds; all if left out.")] = None,
    rounds: Annotated[int, typer.Option(min=0, help="Of swapped features; 0 for none.")] = 0,
    scenes: Annotated[bool, typer.Option(help="Judge it on the package's scenes too.")] = False,
) -> None:  # fmt: skip
    """Measure an exported editor on what it has never seen, and write its card."""
    from training.depth_assess import assess_depth_editor
    from training.depth_editor import DEPTH_STAGES
    from training.editor_assess import assess_editor
    from training.editor_export import depth_facts_of, facts_of

    if checked(stage) in DEPTH_STAGES:
        card = assess_depth_editor(weights / name, data, depth_facts_of(stage, out), worlds=worlds)
    else:
        facts = facts_of(stage, out)
        card = assess_editor(
            weights / name, data, facts, worlds=worlds, rounds=rounds, scenes=scenes
        )
    (weights / name / "card.md").write_text(card)
    typer.echo(card)


@app.command()
def sheet(
    name: str, data: Data = CACHE / "data", weights: Annotated[Path, typer.Option()] = WEIGHTS,
    to: Annotated[Path, typer.Option(help="Folder of the picture.")] = REPORTS,
) -> None:  # fmt: skip
    """Draw an exported editor's answers on eight worlds that it has never seen."""
    import torch

    from attnwarp.editing.small import load_editor
    from training import editor_sheets
    from training.editing_pairs import load_pairs
    from training.editor_assess import answers_of

    torch.set_num_threads(1)
    editor = load_editor(str(weights / name), text_guidance=1.5, image_guidance=1.0)
    size = editor.unet.config.sample_size * editor.factor
    picture = editor_sheets.sheet(answers_of(editor), load_pairs(data, "edit-test"), size=size)
    typer.echo(editor_sheets.write_sheet(picture, to / f"{name}.png"))


if __name__ == "__main__":
    app()
