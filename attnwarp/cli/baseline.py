"""attnwarp baseline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.edit_image import (
    SEGMENTER,
    AtOption,
    BoxOption,
    ControlOption,
    EditorOption,
    InstructionOption,
    MaskOption,
    SegmenterOption,
    ThreadsOption,
    TuneOutsideOption,
    TurntableOption,
    WhereOption,
    check_segmenter,
)
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
    DeviceOption,
    DtypeOption,
    LowMemoryOption,
    MaxSizeOption,
    Reading,
    ScreenFilterOption,
    SplatKindOption,
    reading_options,
)
from attnwarp.cli.shell import assignments, check_out, clear_errors, use_threads
from attnwarp.editing.small import check_words, guide_of
from attnwarp.reporting import reporter


@reading_options()
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
    source: Annotated[
        str | None, typer.Option(metavar="VIEW", help="View that is marked; the first if left out.")
    ] = None,
    masks: Annotated[
        Path | None, typer.Option(help="Folder of PNG masks, NAME.png; white is edited.")
    ] = None,
    mask: MaskOption = None,
    box: BoxOption = None,
    at: AtOption = None,
    words: WhereOption = None,
    segmenter: SegmenterOption = None,
    tune_outside: TuneOutsideOption = False,
    kind: SplatKindOption = None,
    antialiased: AntialiasedOption = None,
    screen_filter: ScreenFilterOption = None,
    max_size: MaxSizeOption = None,
    device: DeviceOption = "auto",
    dtype: DtypeOption = "auto",
    low_memory: LowMemoryOption = False,
    threads: ThreadsOption = None,
    control: ControlOption = None,
    turntable: TurntableOption = None,
    *,
    reading: Reading,
) -> None:
    """Edit a scene by another method, for comparison with attnwarp edit."""
    stopped = f"stopped; what {out} holds is whole, and the same command goes on from it"
    with clear_errors(stopped, out), reporter(title=out.name) as report:
        changes = assignments(change or [], {})
        check_segmenter(segmenter, words)
        check_out(out)
        check_inputs_stay([out / "edited.ply"], [ply, mask])
        check_words(instruction)
        guide_of(editor)  # refuses what is no editor
        from attnwarp import check, methods
        from attnwarp.methods.marks import Marks, numbers

        marks = Marks(
            masks, mask, numbers(box, "X0,Y0,X1,Y1", "--box"), numbers(at, "X,Y", "--at"), words,
            segmenter or SEGMENTER,
        )  # fmt: skip

        others = [name for name in methods.METHODS if name != "attention_warping"]
        check.one_of(method, others, "METHOD")
        settings = methods.preset(method, preset, **changes)
        budget = methods.Budget(seconds, network_rows)
        use_threads(threads)
        from attnwarp.methods.command import run_baseline

        dataset = read_views(data, reading, points=False)
        splats = read_splats(ply, kind, antialiased, screen_filter)
        check_seen(ply, splats, dataset.cameras, report)
        warn_of_misfit(ply, splats, dataset)
        result, page = run_baseline(
            method, dataset, splats, editor, instruction, settings, out,
            budget=budget, marks=marks, tune_outside=tune_outside,
            source=source, max_size=max_size, device=device,
            dtype=dtype, low_memory=low_memory, threads=threads,
            control=control, turntable=turntable, report=report,
        )  # fmt: skip
        ended = f", cut short by its {result.cut.replace('_', ' ')}" if result.cut else ""
        typer.echo(
            f"{out / 'edited.ply'}: {result.counters['edits']} edits of"
            f" {result.counters['views']} views in {sum(result.seconds.values()):.0f} s{ended}"
        )
        typer.echo(page)
