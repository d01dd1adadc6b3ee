"""attnwarp baseline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.files import (
    check_inputs_stay,
    check_seen,
    read_splats,
    read_views,
    warn_of_misfit,
)
from attnwarp.cli.options import (
    AntialiasedOption,
    DataArgument,
    Editing,
    EditorOption,
    InstructionOption,
    Reading,
    ScreenFilterOption,
    SplatKindOption,
    options_of,
)
from attnwarp.cli.shell import assignments, check_out, clear_errors, use_threads
from attnwarp.editing.small import check_words, guide_of
from attnwarp.reporting import reporter


@options_of(Editing, Reading)
def baseline(
    method: Annotated[
        str,
        typer.Argument(help="by_view, igs2gs, dge or gaussctrl; see docs/method/baselines.md."),
    ],
    data: DataArgument,
    ply: Annotated[Path, typer.Option(help="Splats of the scene, such as attnwarp fit makes.")],
    instruction: InstructionOption,
    out: Annotated[Path, typer.Option(help="Folder for the result; a run in it is resumed.")],
    editor: EditorOption = "small-plain",
    preset: Annotated[
        str,
        typer.Option(
            help="The method's choices: default, or as published: released, improved (igs2gs),"
            " paper, random (gaussctrl); see docs/method/baselines.md."
        ),
    ] = "default",
    seconds: Annotated[
        float | None, typer.Option(min=0, help="Begin no edit and no iteration after so many.")
    ] = None,
    network_rows: Annotated[
        int | None, typer.Option(min=0, help="Rows through the network at most.")
    ] = None,
    change: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any setting of the method."),
    ] = None,
    kind: SplatKindOption = None,
    antialiased: AntialiasedOption = None,
    screen_filter: ScreenFilterOption = None,
    *,
    editing: Editing,
    reading: Reading,
) -> None:
    """Edit a scene by another method, for comparison with attnwarp edit."""
    stopped = f"stopped; what {out} holds is whole, and the same command goes on from it"
    with clear_errors(stopped, out), reporter(title=out.name) as report:
        changes = assignments(change or [], {})
        check_out(out)
        check_inputs_stay([out / "edited.ply"], [ply, editing.mask])
        check_words(instruction)
        guide_of(editor)  # refuses what is no editor
        from attnwarp import check, methods

        options = editing.checked()
        others = [name for name in methods.METHODS if name != "attention_warping"]
        check.one_of(method, others, "METHOD")
        settings = methods.preset(method, preset, **changes)
        budget = methods.Budget(seconds, network_rows)
        use_threads(editing.threads)
        from attnwarp.methods.command import edit_dataset

        dataset = read_views(data, reading, points=False)
        splats = read_splats(ply, kind, antialiased, screen_filter)
        check_seen(ply, splats, dataset.cameras, report)
        warn_of_misfit(ply, splats, dataset)
        result, page = edit_dataset(
            method, dataset, splats, editor, instruction, settings, out, options,
            budget=budget, report=report,
        )  # fmt: skip
        ended = f", cut short by its {result.cut.replace('_', ' ')}" if result.cut else ""
        typer.echo(
            f"{out / 'edited.ply'}: {result.counters['edits']} edits of"
            f" {result.counters['views']} views in {sum(result.seconds.values()):.0f} s{ended}"
        )
        typer.echo(page)
