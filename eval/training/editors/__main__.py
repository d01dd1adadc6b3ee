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

REPORTS = Path(__file__).parents[3] / "reports" / "editor"

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
    """Train a stage: plain, drawn, features, control, depth. On a GPU each takes minutes, on a CPU days."""
    import torch

    if device not in ("cpu", "cuda"):
        raise typer.BadParameter(f"got {device!r}, expected cpu or cuda", param_hint="--device")
    if device == "cuda" and not torch.cuda.is_available():
        raise typer.BadParameter("torch finds no GPU here; use cpu", param_hint="--device")
    from training.editors.depth import DEPTH_STAGES, train_depth_stage
    from training.editors.recipe import train_stage

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
def stages(out: Out = CACHE) -> None:
    """Print a table of the trained stages: steps, seconds and losses, from the logs of ``train``."""
    from training.editors.depth import DEPTH_STAGES
    from training.editors.recipe import STAGES
    from training.log import log_path, read_log, table

    logs = [log_path(out / f"{name}.pt") for name in (*STAGES, *DEPTH_STAGES)]
    logs = [path for path in logs if read_log(path)]
    if not logs:
        message = f"{out}: no log of an epoch, which training writes; train a stage first"
        raise typer.BadParameter(message, param_hint="--out")
    typer.echo(table(logs))


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
    scenes: Annotated[bool, typer.Option(help="Judge it on the package's scenes too.")] = False,
) -> None:  # fmt: skip
    """Measure an exported editor on what it has never seen, and write its card.

    Sections of answers, by-clip and carries are left out: these commands write them.
    """
    from training.assess.depth import assess_depth_editor
    from training.assess.editors import assess_editor
    from training.editors.depth import DEPTH_STAGES
    from training.editors.export import depth_facts_of, facts_of

    if checked(stage) in DEPTH_STAGES:
        card = assess_depth_editor(weights / name, data, depth_facts_of(stage, out), worlds=worlds)
    else:
        facts = facts_of(stage, out)
        card = assess_editor(weights / name, data, facts, worlds=worlds, scenes=scenes)
    (weights / name / "card.md").write_text(card)
    typer.echo(card)


def exported(name: str, weights: Path) -> tuple[Any, int]:
    """An exported editor with the guidance of the bundled ones, on one thread, and the side of its pictures in px."""
    import torch

    from attnwarp.editing import small

    torch.set_num_threads(1)
    folder = str(weights / name)
    guidance = (
        {"guidance": small.DEPTH_GUIDANCE}
        if small.guide_of(folder) == "depth"
        else {"text_guidance": small.TEXT_GUIDANCE, "image_guidance": small.IMAGE_GUIDANCE}
    )
    editor: Any = small.load_editor(folder, **guidance)
    return editor, editor.unet.config.sample_size * editor.factor


def judged(name: str, weights: Path, command: str, guide: str = "picture") -> tuple[Any, int, Kept]:
    """An editor of the right guide, the side of its pictures in px, and what a command has kept of it.

    BadParameter: it takes another guide, "picture" or "depth".
    """
    from attnwarp.editing.small import SUMS, guide_of
    from training.assess.card_sections import Kept

    takes = {"picture": "pictures, such as small-plain", "depth": "depth maps, such as small-depth"}
    if guide_of(str(weights / name)) != guide:
        message = f"{name} takes {takes['depth' if guide == 'picture' else 'picture'].split(',')[0]}; give an editor of {takes[guide]}"
        raise typer.BadParameter(message, param_hint="NAME")
    editor, size = exported(name, weights)
    sums = hashlib.sha256((weights / name / SUMS).read_bytes()).hexdigest()
    path = CACHE / "judged" / f"{name}-{sums[:12]}-{command}.json"
    return editor, size, Kept(path, say=partial(typer.echo, err=True))


def add_section(name: str, weights: Path, section: str) -> None:
    """Write a section into an editor's card, in place of a former one, and print it."""
    from training.assess.card_sections import with_section

    path = weights / name / "card.md"
    path.write_text(with_section(path.read_text() if path.exists() else f"# {name}", section))
    typer.echo(section)


@app.command()
def answers(
    name: str, data: Data = CACHE / "data", weights: Cards = WEIGHTS,
    noises: Annotated[int, typer.Option(min=1, help="Of each instruction.")] = 200,
) -> None:  # fmt: skip
    """Count which answers open instructions get, into the card. Six minutes; a stopped run goes on."""
    from training.assess.spread import answered, questions, spread_section
    from training.worlds.editing_pairs import load_pairs

    editor, size, kept = judged(name, weights, "answers")
    asked = questions(load_pairs(data, "edit-test"), size)
    counts = [answered(editor, question, noises, kept) for question in asked]
    add_section(name, weights, spread_section(asked, counts, size=size))


@app.command("by-clip")
def by_clip(
    name: str, data: Data = CACHE / "data", weights: Cards = WEIGHTS,
    draws: Annotated[int, typer.Option(min=1, help="Pictures of each world and kind.")] = 2,
) -> None:  # fmt: skip
    """Judge finish, ground and time of day by clip-small, into the card. Four minutes; a stopped run goes on."""
    from attnwarp.encoders import load_encoder
    from training.assess.by_clip import by_clip_section, judgements
    from training.assess.editors import answers_of
    from training.worlds.editing_pairs import load_pairs

    editor, size, kept = judged(name, weights, "by-clip")
    worlds, judge = load_pairs(data, "edit-test"), load_encoder("clip-small", "clip")
    results = judgements(answers_of(editor), worlds, judge, kept, size=size, draws=draws)
    add_section(name, weights, by_clip_section(results, worlds=len(worlds), draws=draws))


@app.command()
def carries(
    name: str, data: Data = CACHE / "data", weights: Cards = WEIGHTS,
    pairs: Annotated[int, typer.Option(min=1, help="Swaps asked of each question.")] = 200,
) -> None:  # fmt: skip
    """Judge whether swapped features carry the answer, into the card. 40 minutes; a stopped run goes on."""
    from training.assess import carries as editor_carries
    from training.worlds.editing_pairs import load_pairs

    editor, size, kept = judged(name, weights, "carries")
    worlds = load_pairs(data, "edit-test")
    figures = editor_carries.carries(editor, worlds, size=size, pairs=pairs, kept=kept)
    add_section(name, weights, editor_carries.carried_section(figures, pairs))


@app.command()
def inverts(name: str, data: Data = CACHE / "data", weights: Cards = WEIGHTS) -> None:
    """Rebuild pictures from their DDIM inversion by an editor of depth maps, into the card. Three minutes."""
    from training.assess import inverts as depth_inverts
    from training.editors.depth import Prompts
    from training.worlds.editing_pairs import load_pairs

    editor, size, kept = judged(name, weights, "inverts", "depth")
    rebuilt = depth_inverts.inverts(editor, Prompts(load_pairs(data, "edit-test"), size), kept)
    add_section(name, weights, depth_inverts.inverts_section(rebuilt, size=size))


@app.command()
def guidance(
    names: Annotated[list[str], typer.Argument(help="Of editors, such as small-plain small.")],
    data: Data = CACHE / "data", weights: Cards = WEIGHTS,
    to: Annotated[Path, typer.Option(help="Folder of the report.")] = REPORTS,
) -> None:  # fmt: skip
    """Hold guidances against each other on worlds for choices, into guidance.md. Ten minutes an editor; a stopped run goes on."""
    from attnwarp.io.file import write_atomically
    from training.assess.guidance import figures_of, guidance_report, shown
    from training.worlds.editing_pairs import load_pairs

    worlds = shown(load_pairs(data, "edit-choice"))
    results = {}
    for name in names:
        editor, size, kept = judged(name, weights, "guidance")
        results[name] = figures_of(editor, worlds, kept, size=size)
    text = guidance_report(results, worlds=len(worlds))
    to.mkdir(parents=True, exist_ok=True)
    write_atomically(to / "guidance.md", lambda stream: stream.write(text.encode()))
    typer.echo(text)


@app.command()
def sheet(
    name: str, data: Data = CACHE / "data", weights: Cards = WEIGHTS,
    to: Annotated[Path, typer.Option(help="Folder of the picture.")] = REPORTS,
) -> None:  # fmt: skip
    """Draw an exported editor's answers on eight worlds that it has never seen."""
    from training.assess import depth as depth_assess
    from training.assess import sheets as editor_sheets
    from training.assess.editors import answers_of
    from training.worlds.editing_pairs import load_pairs

    editor, size = exported(name, weights)
    worlds = load_pairs(data, "edit-test")
    if editor.guide == "depth":
        picture = editor_sheets.depth_sheet(
            lambda prompts, row, text, seed: depth_assess.draw(
                editor, prompts, row, text, seed=seed
            ),
            worlds,
            size=size,
        )
    else:
        picture = editor_sheets.sheet(answers_of(editor), worlds, size=size)
    typer.echo(editor_sheets.write_sheet(picture, to / f"{name}.png"))


if __name__ == "__main__":
    app()
