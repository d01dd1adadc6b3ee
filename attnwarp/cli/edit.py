"""Command attnwarp edit."""

from __future__ import annotations

import re
import warnings
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from attnwarp.cli.bundled_scene import SIZE, bundled, capture, exact_masks
from attnwarp.cli.files import (
    check_inputs_stay,
    check_seen,
    note_held_out,
    read_splats,
    read_views,
    warn_of_misfit,
)
from attnwarp.cli.options import (
    LONGEST_EDIT,
    AntialiasedOption,
    AnywayOption,
    DataArgument,
    Editing,
    EditorOption,
    InstructionOption,
    Kind,
    Marking,
    Reading,
    ScreenFilterOption,
    of_machine,
    of_method,
    of_splats,
    option,
    options_of,
)
from attnwarp.cli.shell import assignments, check_out, clear_errors, use_threads, warned
from attnwarp.editing.small import check_words, guide_of, own_steps_of, say_foreign
from attnwarp.errors import InputWarning
from attnwarp.reporting import reporter

DECIDING = (*(field.name for field in fields(Marking)), "tune_outside", "max_size")
"""Fields of `Editing` that decide the result of an edit."""

FEWER_STEPS = 10
"""Steps of `extended` by small-plain: as near to the wanted edit as its own 20."""


@options_of(Editing, Reading)
def edit(
    data: DataArgument,
    instruction: InstructionOption,
    editor: EditorOption = "small-plain",
    out: Annotated[
        Path | None,
        option(
            "Write the result to this folder, or resume the edit in it (default: one of"
            " runs/edits, named by DATA and the instruction).",
            "FOLDER",
        ),
    ] = None,
    method: Annotated[
        str,
        of_method(
            "Edit by this method: attention_warping (default), by_view, igs2gs, dge, gaussctrl,"
            " corresponding, fused, guided or warped_reference; see docs/method/baselines.md.",
            "NAME",
            show_default=False,
        ),
    ] = "attention_warping",
    preset: Annotated[
        str | None,
        of_method(
            "Begin with this preset of the method's settings; attention_warping has extended"
            " (default), corrected, paper, released and released-controlnet; see"
            " docs/method/algorithm.md.",
            "NAME",
        ),
    ] = None,
    source_picture: Annotated[
        Path | None,
        of_method("Take this picture, edited elsewhere, as the source view's edit.", "FILE"),
    ] = None,
    preview: Annotated[
        bool,
        of_method(
            "Edit the source view alone, by four seeds from --seed on, and write a page of these"
            " answers, FOLDER/preview/index.html.",
            None,
            "--preview",
        ),
    ] = False,
    answer: Annotated[
        int | None,
        of_method(
            "Go on from this answer of --preview, by its number, which is its seed.", "N", min=0
        ),
    ] = None,
    stages: Annotated[
        int | None,
        of_method("Edit and tune in so many stages (default of extended: 3).", "N", min=1),
    ] = None,
    views_per_stage: Annotated[
        int | None,
        of_method(
            "Edit so many new views in each stage (default of extended: an equal share).",
            "N",
            min=1,
        ),
    ] = None,
    steps: Annotated[
        int | None,
        of_method(
            "Denoise in so many steps (default: the editor's own number; with extended"
            " small-plain takes 10).",
            "N",
            min=1,
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        of_method(
            "Tune the splats for so many iterations in each stage (default of extended: 50).",
            "N",
            min=0,
        ),
    ] = None,
    size: Annotated[
        int | None,
        of_method(
            "Edit at this longest side in px; the change is enlarged to the picture's size"
            " (default: the editor's own size, 128 for a bundled scene).",
            "N",
            min=16,
            max=LONGEST_EDIT,
        ),
    ] = None,
    alone: Annotated[
        bool,
        of_method(
            "Carry no features from view to view, for comparison.", None, "--each-view-alone"
        ),
    ] = False,
    seed: Annotated[
        int | None, of_method("Draw everything random by this seed (default 0).", "N", min=0)
    ] = None,
    change: Annotated[
        list[str] | None,
        of_method(
            "Change any other setting of the preset; may be repeated.", "NAME=VALUE", "--set"
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        of_method(
            "Stop editing and tuning after this many seconds, and write the scene as it is then"
            " (default: no limit).",
            "S",
            min=0,
        ),
    ] = None,
    network_rows: Annotated[
        int | None,
        of_method(
            "Stop before more rows than this go through the network, one a picture, step and"
            " branch of guidance (default: no limit).",
            "N",
            min=0,
        ),
    ] = None,
    ply: Annotated[
        Path | None,
        of_splats(
            "Edit these splats (.ply, .splat, .spz, .sog, .ksplat); without any, they are fitted"
            " first.",
            "FILE",
        ),
    ] = None,
    kind: Annotated[
        Kind | None,
        of_splats(
            "Fit 2dgs (default) or 3dgs; with --ply, read it as this kind, whatever it says.",
        ),
    ] = None,
    antialiased: AntialiasedOption = None,
    screen_filter: ScreenFilterOption = None,
    store: Annotated[
        Literal["cpu", "device", "disk"] | None,
        of_machine(
            "Keep recorded features in main memory (cpu, the default), with the editor (device) or"
            " on disk.",
        ),
    ] = None,
    anyway: AnywayOption = False,
    *,
    editing: Editing,
    reading: Reading,
) -> None:
    """Edit a scene: one view by an instruction, the others along with it, the splats on all.

    DATA may be a bundled scene: bear, dinosaur, fence or spheres, edited inside an exact mask.
    """
    if out is None:
        out = Path(
            "runs",
            "edits",
            re.sub(r"[^a-z0-9]+", "-", f"{data.stem} {instruction}".lower()).strip("-"),
        )
    stopped = f"stopped; what {out} holds is whole, and the same command goes on from it"
    with clear_errors(stopped, out), reporter(title=out.name) as report:
        options: dict[str, Any] = {
            "stages": stages, "views_per_stage": views_per_stage, "steps": steps,
            "iterations": iterations, "size": size, "seed": seed,
        }  # fmt: skip
        changes = {name: value for name, value in options.items() if value is not None}
        flags = {name: f"--{name.replace('_', '-')}" for name in options}
        if alone:
            changes["a0"], flags["a0"] = 0.0, "--each-view-alone"
        scene = str(data) if str(data) in bundled() and not data.exists() else None
        if str(data) in bundled() and not scene:
            warnings.warn(
                f"{data}: {data.resolve()} is edited, not the bundled scene of that name",
                InputWarning,
                stacklevel=1,
            )
        if scene:
            changes.setdefault("size", SIZE)
        changes |= assignments(change or [], flags)
        for name, value in {"antialiased": antialiased, "screen-filter": screen_filter}.items():
            if ply is None and value is not None:
                raise ValueError(f"--{name}: says how a PLY is read, and none is given; see --ply")
        check_out(out)
        results = ("edited.ply", "edited-3dgs.ply")
        files = [path for path in (source_picture, ply, editing.mask) if path is not None]
        check_inputs_stay((out / name for name in results), files)
        guide_of(editor)  # refuses an unknown editor
        check_words(editor, instruction, anyway=anyway)
        from attnwarp import check, methods
        from attnwarp.command.edit import (
            FitPlan,
            check_asked,
            check_marked,
            edit_dataset,
            view_of,
        )
        from attnwarp.command.marks import Marks
        from attnwarp.command.preview import Preview
        from attnwarp.fit import read_exposures
        from attnwarp.io.file import existing_file
        from attnwarp.methods.change import say_change

        edit_options = editing.checked()
        check.one_of(method, list(methods.METHODS), "--method")
        given = {"source_picture": source_picture, "store": store}
        own: dict[str, Any] = {k: v for k, v in given.items() if v is not None}
        asked_for = {"answer": answer is not None, "preview": preview}
        answers = [name for name, wanted in asked_for.items() if wanted]
        if len([*answers, *["source_picture"] * (source_picture is not None)]) > 1:
            other = "--source-picture" if source_picture is not None else "--preview"
            raise ValueError(
                f"--{answers[0]}: got {other} too, expected one of the two: --preview shows edits"
                " of the source, --answer takes one of them, --source-picture one made elsewhere"
            )
        used = [*own, *answers, *["each_view_alone"] * alone]
        if used and method != "attention_warping":
            name = used[0].replace("_", "-")
            raise ValueError(f"--{name}: is of attention_warping, not of {method}; leave it out")
        if method == "attention_warping" and preset is None:
            preset = "extended"  # carries most; the library's default is the method as corrected
        fewer = preset == "extended" and editor == "small-plain"
        changes.setdefault("steps", FEWER_STEPS if fewer else own_steps_of(editor))
        settings = methods.preset(method, preset, **changes)
        budget = methods.Budget(seconds, network_rows)
        use_threads(editing.threads)
        for path in files:
            existing_file(path)
        typed = {
            "scene": scene, "editor": editor, "kind": kind,
            **{name: value for name, value in vars(editing).items() if name in DECIDING},
        }  # fmt: skip
        asked = {
            k: " ".join(v) or None if isinstance(v, (list, tuple)) else v if v is None else str(v)
            for k, v in typed.items()
        }
        shown = Preview(out, settings.seed, answer) if answers else None
        check_asked(method, instruction, settings, budget, out, edit_options, asked, shown)
        origin = ""
        if scene:
            data = out / "scene"
            origin = capture(scene, data, report)
            if ply is None and kind is None:
                ply = data / "splats.ply"
        dataset = read_views(data, reading)
        check_marked(edit_options, dataset)
        if scene and not edit_options.marks.option:
            masks = exact_masks(data, instruction, report, anyway=anyway)
            edit_options = replace(edit_options, marks=Marks(masks))
        notes = []
        if not scene and (foreign := say_foreign(editor)):
            notes.append(foreign)
            report.log(foreign)
        splats = None if ply is None else read_splats(ply, kind, antialiased, screen_filter)
        if ply is not None and splats is not None:
            check_seen(ply, splats, dataset.cameras, report)
            warn_of_misfit(ply, splats, dataset)
            if note := note_held_out(ply, dataset, view_of(dataset, editing.source)):
                warnings.warn(note, InputWarning, stacklevel=1)
        result, page = edit_dataset(
            method, dataset, splats, editor, instruction, settings, out, edit_options,
            fit_plan=FitPlan(kind=kind[:2]) if kind else FitPlan(),
            notes=lambda: [*notes, *warned()], origin=origin,
            exposures={} if ply is None else read_exposures(ply),
            budget=budget, asked=asked, preview=shown, report=report, **own,
        )  # fmt: skip
        if isinstance(result, list):
            typer.echo("\n".join([*result, "to go on from one: --answer N in place of --preview"]))
            typer.echo(page)
            return
        typer.echo(say_change(result.change, edit_options.marks.option != ""))
        views = len(result.edited)
        carried = ""
        if getattr(settings, "a0", 0) > 0 and views > 1:
            share = result.counters["injected"]
            carried = f"; {share:.0%} of the targets' pixels got features of the source"
        ended = f"; cut short by its {result.cut.replace('_', ' ')}" if result.cut else ""
        typer.echo(
            f"{out / 'edited.ply'}: {views} edited view{'s' * (views > 1)} in"
            f" {sum(result.seconds.values()):.0f} s{carried}{ended}"
        )
        typer.echo(page)
