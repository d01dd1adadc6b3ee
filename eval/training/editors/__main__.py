"""Rebuild the bundled editors from nothing: python -m training.editors, from the folder eval/."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from training.assess.card_sections import Kept

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
Cards = Annotated[Path, typer.Option(help="Folder of the editors and their cards.")]
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
    """Train a stage: plain, drawn, depth, joint. On a GPU each takes minutes, on a CPU days."""
    import torch

    if device not in ("cpu", "cuda"):
        raise typer.BadParameter(f"got {device!r}, expected cpu or cuda", param_hint="--device")
    if device == "cuda" and not torch.cuda.is_available():
        raise typer.BadParameter("torch finds no GPU here; use cpu", param_hint="--device")
    from training.editors.depth import DEPTH_STAGES, train_depth_stage
    from training.editors.joint import JOINT_STAGES
    from training.editors.recipe import train_stage

    if stage in JOINT_STAGES:
        train_stage(stage, data, out, stage=JOINT_STAGES[stage], threads=threads, device=device)
        return
    trainer = train_depth_stage if checked(stage) in DEPTH_STAGES else train_stage
    trainer(stage, data, out, threads=threads, device=device)


def checked(stage: str) -> str:
    """The stage's name. BadParameter: there is none of that name."""
    from training.editors.depth import DEPTH_STAGES
    from training.editors.recipe import STAGES

    if stage not in (*STAGES, *DEPTH_STAGES):
        names = ", ".join([*STAGES, *DEPTH_STAGES])
        raise typer.BadParameter(f"got {stage!r}, expected one of {names}", param_hint="STAGE")
    return stage


@app.command()
def export(stage: str, name: str, out: Out = CACHE, weights: Cards = WEIGHTS) -> None:
    """Write a stage's editor, as far as it has come, into the package under a name such as small-plain."""
    from training.editors.depth import DEPTH_STAGES
    from training.editors.export import export_depth_editor, export_editor

    write = export_depth_editor if checked(stage) in DEPTH_STAGES else export_editor
    typer.echo(write(stage, out, weights / name))


@app.command()
def assess(
    stage: str, name: str, out: Out = CACHE, data: Data = CACHE / "data",
    weights: Cards = WEIGHTS,
    worlds: Annotated[int | None, typer.Option(help="Test worlds; all if left out.")] = None,
) -> None:  # fmt: skip
    """Measure an exported editor on what it has never seen, and write its card but for what carries writes."""
    from training.assess.depth import assess_depth_editor
    from training.assess.editors import assess_editor
    from training.editors.depth import DEPTH_STAGES
    from training.editors.export import depth_facts_of, facts_of

    if checked(stage) in DEPTH_STAGES:
        card = assess_depth_editor(weights / name, data, depth_facts_of(stage, out), worlds=worlds)
    else:
        card = assess_editor(weights / name, data, facts_of(stage, out), worlds=worlds)
    (weights / name / "card.md").write_text(card)
    typer.echo(card)


def judged(name: str, weights: Path, command: str) -> tuple[Any, int, Kept]:
    """An exported editor of pictures with the guidance of the bundled ones, on one thread, the side of its pictures in px, and what a command has kept of it.

    BadParameter: it takes depth maps.
    """
    import torch

    from attnwarp.editing import small
    from training.assess.card_sections import Kept

    folder = weights / name
    if small.guide_of(str(folder)) != "picture":
        message = f"{name} takes depth maps; give an editor of pictures, such as small-plain"
        raise typer.BadParameter(message, param_hint="NAME")
    torch.set_num_threads(1)
    guidance = {"text_guidance": small.TEXT_GUIDANCE, "image_guidance": small.IMAGE_GUIDANCE}
    editor = small.load_editor(str(folder), **guidance)
    sums = hashlib.sha256((folder / small.SUMS).read_bytes()).hexdigest()
    path = CACHE / "judged" / f"{name}-{sums[:12]}-{command}.json"
    kept = Kept(path, say=partial(typer.echo, err=True))
    return editor, editor.own_size, kept


@app.command()
def carries(
    name: str,
    data: Data = CACHE / "data",
    weights: Cards = WEIGHTS,
    pairs: Annotated[int, typer.Option(min=1, help="Swaps asked of each question.")] = 200,
) -> None:
    """Judge whether swapped features carry the answer, into the card. 40 minutes; a stopped run goes on."""
    from training.assess import carries as editor_carries
    from training.assess.card_sections import with_section
    from training.worlds.editing_pairs import load_pairs

    editor, size, kept = judged(name, weights, "carries")
    worlds = load_pairs(data, "edit-test")
    figures = editor_carries.carries(editor, worlds, size=size, pairs=pairs, kept=kept)
    path, section = weights / name / "card.md", editor_carries.carried_section(figures, pairs)
    path.write_text(with_section(path.read_text() if path.exists() else f"# {name}", section))
    typer.echo(section)


if __name__ == "__main__":
    app()
