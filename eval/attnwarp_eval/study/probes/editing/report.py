"""Report of edited scenes: the editor's abilities, agreement by yaw and by scene, seconds by part,
and the best variant for a given time.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

from attnwarp_eval.document import charts
from attnwarp_eval.document.model import Grid, Picture, Section, Table
from attnwarp_eval.document.numbers import decibels, number, pooled, spread
from attnwarp_eval.metrics.multiview import BELOW_FLOOR
from attnwarp_eval.statistics.intervals import common, interval, over_scenes
from attnwarp_eval.study.probe_report import (
    Layout,
    Place,
    ProbeReport,
    in_degrees,
    register_report,
    report_of,
    views_of,
)
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.record import PictureFile, Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.edits import EditingPart
from attnwarp_eval.study.shared.encoders import encoders_named
from attnwarp_eval.study.shared.method_run import PARTS, WHOLE, is_alone
from attnwarp_eval.study.turns import timed_in_turn

BY_YAW = {
    "multiview.same_answer.edit": "views with the source's answer",
    "multiview.delta_e_above.edit_inside": "disagreement with the source above its floor, dE00",
    "fidelity.psnr.edit_inside": "PSNR to the true edit inside the object, dB",
}
"""Figures that are shown by yaw, with descriptions."""

BY_SCENE = {
    "multiview.same_answer.edit_seen": "Views with the source's answer where the source saw it",
    "multiview.same_answer.edit": "Views with the source's answer",
    "multiview.delta_e_above.edit_inside": "Disagreement with the source above its floor, dE00",
    "multiview.delta_e_above.edit_next": "Disagreement of neighbouring views above its floor, dE00",
    "multiview.delta_e_above.render_inside": "Disagreement of renders above its floor, dE00",
    "fidelity.psnr.edit_inside": "PSNR to the true edit inside the object, dB",
    "fidelity.mse.edit_inside": "The same, pooled: of the mean squared error over the views, dB",
    "depth.abs_rel.before": "AbsRel of the splats' depth before the edit",
    "depth.abs_rel.after": "AbsRel of the splats' depth after tuning",
}

DISAGREEMENT = "multiview.delta_e_above.edit_inside"

ONE_SOURCE = frozenset({"attention_warping", "true pictures"})
"""Methods that edit the source view in the same way and differ in the others."""


CHOSEN_BY = ("multiview.delta_e_above.edit_inside", "fidelity.mse.edit_inside")
"""Figures by which the variant for a given time is chosen; lower is better."""


@register_report
class EditingReport(ProbeReport):
    """Agreement, fidelity and seconds of edits by variant."""

    name = "editing"
    measures = "edits of scenes against true pictures of the edit"
    tabulates_all = True
    columns: ClassVar[Mapping[str, str]] = {
        "same answer": "multiview.same_answer.edit",
        "... where the source saw it": "multiview.same_answer.edit_seen",
        "disagreement above floor, dE00": "multiview.delta_e_above.edit_inside",
        "... of neighbours": "multiview.delta_e_above.edit_next",
        "... in renders": "multiview.delta_e_above.render_inside",
        "PSNR to truth inside, dB": "fidelity.psnr.edit_inside",
        "... inside, pooled": "fidelity.mse.edit_inside",
        "PSNR of renders, dB": "fidelity.psnr.render_inside",
        "... of renders, pooled": "fidelity.mse.render_inside",
        "Edit PSNR, dB": "image.psnr.edit_render",
        "Edit PSNR, pooled": "image.mse.edit_render",
        "CLIP direction": "embedding.clip_directional.render",
        "CLIP image": "embedding.clip_image.render",
        "DINO image": "embedding.dino_image.render",
        "AbsRel of depth after": "depth.abs_rel.after",
    }
    contrasts = (
        "multiview.same_answer.edit",
        "multiview.delta_e_above.edit_inside",
        "multiview.delta_e_above.render_inside",
        "fidelity.psnr.edit_inside",
        "fidelity.psnr.render_inside",
        "depth.abs_rel.after",
    )
    stage = "whole"
    cost = "whole"
    cost_of = "an edit"
    cost_text = (
        "Seconds are those of one whole edit of a scene: source, warps, edited views and tuning."
    )

    def sections(self, results: Results, layout: Layout) -> Iterator[tuple[Place, Section]]:
        """Sections on the editor's abilities, budgets, figures by yaw, time by part."""
        if not results.finished(self.name):
            return
        able = abilities(results, self.name)
        spec = results.finished(self.name)[0][1].spec
        if "encoders" in spec:
            able.text.append(encoders_named(results.study, spec))
        yield Place.INSTRUMENT, able
        part = results.study.part(EditingPart).editing
        if (section := budgets(results, self.name)) is not None:
            yield Place.RESULT, section
        if part.by_yaw:
            yield Place.RESULT, by_yaw(results, self.name, part.by_yaw, layout)
            yield Place.RESULT, by_scene(results, self.name, part.by_yaw)
        if layout.timings:
            yield Place.RESULT, parts_of_time(results, self.name)
        if layout.timings and part.choice:
            yield (
                Place.RESULT,
                choice(results, self.name, part.choice, CHOSEN_BY),
            )

    def gallery(self, results: Results) -> Section | None:
        """Edited views side by side."""
        return side_by_side(results, self.name)


def abilities(results: Results, probe: str) -> Section:
    """Section on the editor's success in the source view, and in every view alone."""
    names = controls(results, probe)
    section = Section("What the editor can do")
    section.text = [
        (
            "An edit counts as done where the picture, inside the edited object, is nearer to a"
            " right answer than to the unedited picture, and than the unedited picture is. So its"
            " PSNR to that answer, in dB inside the object, must exceed both numbers in brackets:"
            " that of the unedited picture to the answer, and its own to the unedited picture."
            " **Agreement between views is judged only where the source's edit is done**; the"
            " others have undefined figures. The edits of the control stand here by name; a"
            " comparison counts those of each method."
        ),
    ]
    rows = []
    for name in names:
        for scene, seed, record in results.records(probe, name):
            edit = record.extra
            rows.append(
                [
                    scene,
                    edit.name,
                    edit.instruction,
                    name,
                    str(seed),
                    edit.source.answer or "–",
                    _against(edit.source),
                    "yes" if edit.source.done else "**no**",
                    _against(edit.alone),
                    "yes" if edit.alone.done else "no",
                ]
            )
    columns = [
        "scene",
        "edit",
        "instruction",
        "variant",
        "seed",
        "nearest answer of the source",
        "source, dB",
        "source done",
        "all views, dB",
        "all views done",
    ]
    section.tables = [*_done_by_method(results, probe), Table(columns, rows)]
    return section


def _done_by_method(results: Results, probe: str) -> list[Table]:
    """Tables of the source edits that succeeded, by variant of a comparison; none for a study of
    one method.
    """
    records = {
        name: [record for _, _, record in results.records(probe, name)]
        for name in results.study.variants
    }
    methods = {record.spec["method"] for own in records.values() for record in own}
    if methods <= ONE_SOURCE:
        return []
    rows = [
        [name, str(sum(record.extra.source.done for record in own)), str(len(own))]
        for name, own in records.items()
        if own
    ]
    return [Table(["variant", "source edits done", "of"], rows, "Each method's own source edits")]


def controls(results: Results, probe: str) -> list[str]:
    """Measured variants that edit each view alone without a budget; without any, the first measured
    variant.
    """
    measured = [
        (name, records[0][2].spec)
        for name in results.study.variants
        if (records := results.records(probe, name))
    ]
    alone = [name for name, spec in measured if is_alone(spec)]
    return alone or [name for name, _ in measured[:1]]


def _against(judgement: Any) -> str:
    limits = f"{number(judgement.unedited)}, {number(judgement.unchanged)}"
    return f"{number(judgement.psnr)} ({limits})"


def by_yaw(results: Results, probe: str, names: Sequence[str], layout: Layout) -> Section:
    """Means over scenes at each yaw from the source."""
    measured = [name for name in names if results.records(probe, name)]
    yaws = sorted(
        {
            view.yaw
            for name in measured
            for _, _, record in results.records(probe, name)
            for view in record.views
        }
    )
    curves = {
        (metric, name): [
            over_scenes(results.views(probe, name, metric, (yaw, yaw))) for yaw in yaws
        ]
        for metric in BY_YAW
        for name in measured
    }
    path = layout.figure("editing-by-yaw.svg")
    with charts.drawing(path, columns=len(BY_YAW)) as panels:
        for axes, (metric, title) in zip(panels, BY_YAW.items(), strict=True):
            series = [charts.Line(name, yaws, curves[metric, name]) for name in measured]
            charts.lines(
                axes,
                series,
                x="yaw from the source, degrees",
                y=_unit(metric),
                title=title,
                share="same_answer" in metric,
                legend=metric == list(BY_YAW)[-1],
                apart=charts.APART,
            )
    tables = [
        Table(
            ["variant", *(f"{yaw:g}°" for yaw in yaws)],
            [[name, *(number(v.mean) for v in curves[metric, name])] for name in measured],
            title,
            folded=True,
        )
        for metric, title in BY_YAW.items()
    ]
    text = [
        (
            "Means over the scenes whose source edit was done. Bars are 95 % intervals over scenes;"
            " of fewer than six scenes they end at the lowest and the highest one."
        ),
        BELOW_FLOOR,
    ]
    for name in measured:
        scenes = dict.fromkeys(scene for scene, _, _ in results.records(probe, name))
        if len(scenes) < len(results.study.scenes):
            text.append(f"**Of {', '.join(scenes)} alone, not to be compared: {name}.**")
    figure = Picture(f"figures/{path.name}", "Agreement and fidelity by yaw from the source.")
    return Section("Edited views by yaw", text, tables, [figure])


def by_scene(results: Results, probe: str, names: Sequence[str]) -> Section:
    """A table for each figure: variants by scenes."""
    measured = [name for name in names if results.records(probe, name)]
    scenes = results.study.scene_names
    tables = []
    for metric, title in BY_SCENE.items():
        rows = []
        for name in measured:
            table = results.views(probe, name, metric)
            means = [over_scenes({s: table.get(s, {})}).mean for s in scenes]
            squared = report_of(probe).probe.metric(metric).squared
            one, overall = (decibels, pooled) if squared else (number, spread)
            rows.append([name, *map(one, means), overall(over_scenes(table))])
        tables.append(Table(["variant", *scenes, "all scenes"], rows, title))
    tables.insert(0, _ratios(results, probe, measured))
    tables += _injected(results, probe, measured)
    text = [
        (
            "A dash: no view has the figure. Agreement needs a source edit that is done, a view"
            " that was edited, and a surface of the object in both views. The share of views with"
            " the source's answer needs an edit with several answers besides."
        ),
        BELOW_FLOOR,
        (
            "A part of the control's disagreement is over the views that both have. A control at or"
            " below its floor has no parts, and the cell says so."
        ),
    ]
    return Section("Edited views by scene", text, tables)


def _injected(results: Results, probe: str, names: Sequence[str]) -> list[Table]:
    """Shares of injected features: variants by scenes; none if no variant injects."""
    scenes = results.study.scene_names
    rows = []
    for name in names:
        shares: dict[str, list[float]] = {}
        for scene, _, record in results.records(probe, name):
            shares.setdefault(scene, []).append(record.extra.injected)
        if any(any(own) for own in shares.values()):
            means = [_mean(shares.get(scene, [])) for scene in scenes]
            rows.append([name, *(number(mean) for mean in means), spread(interval(shares))])
    title = "Share of the targets' pixels that got features of a source; the rest is edited alone"
    return [Table(["variant", *scenes, "all scenes"], rows, title)] if rows else []


def _ratios(results: Results, probe: str, names: Sequence[str]) -> Table:
    """Ratio of disagreement above the floor to the control's with the same editor."""
    control = {
        results.records(probe, name)[0][2].spec["editor"]["sha256"]: name
        for name in reversed(controls(results, probe))
    }
    rows = []
    for name in names:
        base = control.get(results.records(probe, name)[0][2].spec["editor"]["sha256"], "")
        if base in ("", name):
            continue
        shared = common([results.views(probe, each, DISAGREEMENT) for each in (name, base)])
        parts = [_part(results, probe, (name, base), shared, s) for s in results.study.scene_names]
        rows.append([name, base, *parts])
    title = "Disagreement with the source above its floor, as a part of the control's"
    return Table(["variant", "control", *results.study.scene_names], rows, title)


def _part(
    results: Results,
    probe: str,
    names: tuple[str, str],
    shared: Sequence[Mapping[str, Mapping[str, float]]],
    scene: str,
) -> str:
    """The ratio of a variant's sum over the shared views to its control's, or why there is none.

    Args:
        names: names of the variant and its control.
        shared: values of both in their shared views, by scene.
    """
    if scene in shared[0]:
        own, control = (sum(table[scene].values()) for table in shared)
        return number(own / control) if control > 0 else "below the floor"
    for name, whose in zip(names, ("", "control's "), strict=True):
        records = [record for where, _, record in results.records(probe, name) if where == scene]
        if not any(record.extra.source.done for record in records):
            return f"{whose}source edit not done"
    return "no view in common"


SOURCE = "source's edit"
"""Column of each method's edit of the source."""

UNDONE = "**source edit failed**"
"""Suffix of a method's name if its edit of the source failed."""


def side_by_side(results: Results, probe: str) -> Section | None:
    """A grid for each edit: columns are views, rows the unedited view, methods, and truth."""
    edits: dict[tuple[str, str], dict[str, Record[EditResult]]] = {}
    for cell, record in results.finished(probe):
        if record.pictures:
            own = edits.setdefault((cell.scene, record.extra.name), {})
            own.setdefault(cell.variants[0], record)
    if not edits:
        return None
    grids = [
        _grid(f"{scene}: “{next(iter(own.values())).extra.instruction}”", own)
        for (scene, _), own in edits.items()
    ]
    text = [
        "Rows are methods, columns views. The truth is that of the answer that a source's edit"
        " gave. A method whose source edit failed takes part in no comparison."
    ]
    return Section("Edited views side by side", text, grids=grids)


def _grid(caption: str, methods: Mapping[str, Record[EditResult]]) -> Grid:
    """Pictures of one edit, by method and view."""
    files = {
        name: {(p.content, p.view.rpartition("/")[2]): p for p in record.pictures}
        for name, record in methods.items()
    }
    views = list(dict.fromkeys(view for own in files.values() for _, view in own))
    heads = [SOURCE, *in_degrees(views, views_of(methods.values()))]

    def row(
        label: str, own: Mapping[tuple[str, str], PictureFile], shown: str, source: str = ""
    ) -> tuple[str, list[Picture | None]]:
        first = next((p for (content, _), p in own.items() if content == source), None)
        pictures = [first, *(own.get((shown, view)) for view in views)]
        return label, [
            None if picture is None else Picture(picture.path, f"{label}, {head}")
            for picture, head in zip(pictures, heads, strict=True)
        ]

    rows = [row("before", next(iter(files.values())), "before")]
    truths: dict[tuple[str, ...], list[str]] = {}
    for name, own in files.items():
        undone = "" if methods[name].comparable else f" {UNDONE}"
        rows.append(row(name + undone, own, "edited", "source-edit"))
        if truth := tuple(p.sha256 for (content, _), p in own.items() if content == "truth"):
            truths.setdefault(truth, []).append(name)
    for names in truths.values():
        label = "truth" if len(truths) == 1 else f"truth: {', '.join(names)}"
        rows.append(row(label, files[names[0]], "truth"))
    return Grid(caption, heads, rows)


def parts_of_time(results: Results, probe: str) -> Section:
    """Mean seconds of each part, and the ratio of editing to the control's."""
    control = controls(results, probe)[0]
    base = _seconds(results, probe, control)
    rows, columns = [], ["variant", *PARTS, "whole", "editing, ratio to control", "network rows"]
    for name in results.study.variants:
        records = results.records(probe, name)
        if not records:
            continue
        own = _seconds(results, probe, name)
        shared = [cell for cell in own if cell in base and _editing(base[cell]) > 0]
        ratios = [_editing(own[cell]) / _editing(base[cell]) for cell in shared]
        means = [
            _over_scenes((scene, row[part]) for (scene, *_), row in own.items()) for part in PARTS
        ]
        whole = _over_scenes((scene, sum(row.values())) for (scene, *_), row in own.items())
        counts = _over_scenes(
            (scene, record.cost.counters.get("network_rows", 0)) for scene, _, record in records
        )
        rows.append(
            [
                name,
                *(number(value) for value in means),
                number(whole),
                number(statistics.median(ratios) if ratios else None),
                number(counts),
            ]
        )
    better = (
        "Where it differs from the table of seconds taken in turn, believe that one."
        if timed_in_turn(results, WHOLE) is not None
        else "This run has no seconds taken in turn, which would be the ones to believe."
    )
    text = [
        (
            "Own seconds of the cells, as means over scenes: they show how the time of an edit"
            " divides. Each cell ran at another time, beside whatever else the machine did."
            f" {better} The ratio is the median over scenes, edits and seeds of source, warps and"
            f" edited views together against {control!r}, tuning apart."
        ),
    ]
    timed = tuple(columns[1:-1])
    return Section("Seconds by part", text, [Table(columns, rows, timed=timed)])


def choice(results: Results, probe: str, names: Sequence[str], metrics: Sequence[str]) -> Section:
    """The best variant for a given time: chosen on every other scene, checked on the rest."""
    scenes = results.study.scene_names
    chosen_on, checked_on = scenes[::2], scenes[1::2]
    measured = [name for name in names if results.records(probe, name)]
    timed = timed_in_turn(results, WHOLE)
    if timed is None:
        seconds = {name: results.usual_seconds(probe, name, WHOLE) for name in measured}
        origin = "Seconds are those of the fronts: of one pass, for orientation."
    else:
        seconds = {name: timed.seconds(name).mean for name in measured if name in timed.names}
        origin = (
            "Seconds are those of the fronts, taken in turn in one process:"
            f" {', '.join(t.of for t in timed.turns)}."
        )
        if rest := [name for name in measured if name not in seconds]:
            origin += f" Not timed in turn, so left out: {', '.join(rest)}."
    section = Section("Which variant for a given time")
    section.text = [
        (
            "Of the variants that take at most the seconds of the row, the one with the least mean"
            f" on {', '.join(chosen_on)}; beside it the same variant on"
            f" {', '.join(checked_on) or 'no other scene'}, which had no part in the choice."
        ),
        origin,
    ]
    columns = ["seconds at most", "variant", "where chosen", "elsewhere", "best elsewhere"]
    for metric in metrics:
        shared = results.shared(probe, list(seconds), metric)
        section.text += shared.text(metric)
        rows, last = [], ""
        for limit in sorted(seconds.values()):
            scores = {
                name: (shared.mean(name, chosen_on).mean, shared.mean(name, checked_on).mean)
                for name, taken in seconds.items()
                if taken <= limit and name not in shared.apart
            }
            defined = {name: pair for name, pair in scores.items() if math.isfinite(pair[0])}
            best = min(defined, key=lambda name: defined[name][0], default="")
            if not best or best == last:
                continue
            last = best
            others = {n: pair[1] for n, pair in scores.items() if math.isfinite(pair[1])}
            least = min(others, key=others.__getitem__, default="–")
            chosen, checked = defined[best]
            rows.append([number(limit), best, number(chosen), number(checked), least])
        section.tables.append(Table(columns, rows, metric, timed=(columns[0],)))
    return section


def budgets(results: Results, probe: str) -> Section | None:
    """Section on the use of budgets; None if no method has one."""
    columns = [
        "variant",
        "budget, s",
        "seconds of",
        "network rows at most",
        "cells cut short",
        "taken, s",
        "network rows",
        "edited views",
        "iterations of tuning",
    ]
    rows, cut, untuned = [], [], []
    for name in results.study.variants:
        cells = [
            (scene, record)
            for scene, _, record in results.records(probe, name)
            if record.extra.budget
        ]
        if not cells:
            continue
        records = [record for _, record in cells]
        spent = [record.extra.budget for record in records]
        ended = [value.cut for value in spent if value.cut is not None]
        if ended:
            by = " and ".join(sorted({limit.replace("_", " ") for limit in ended}))
            cut.append(f"{name} ({len(ended)} of {len(spent)}, by {by})")
        idle = sum(record.cost.counters["iterations"] == 0 for record in records)
        if idle:
            untuned.append(f"{name} ({idle} of {len(spent)})")
        rows.append(
            [
                name,
                number(_limit(cells, "seconds")),
                spent[0].seconds_of or "–",
                number(_limit(cells, "network_rows")),
                f"{len(ended)} of {len(spent)}",
                number(_over_scenes((s, r.cost.seconds["whole"] or 0.0) for s, r in cells)),
                number(_over_scenes((s, r.cost.counters["network_rows"]) for s, r in cells)),
                number(_over_scenes((s, r.extra.edited) for s, r in cells)),
                number(_over_scenes((s, r.cost.counters["iterations"]) for s, r in cells)),
            ]
        )
    if not rows:
        return None
    text = [
        (
            "Means over scenes. Nothing begins beyond a budget, so a method may"
            " take a little longer. **A budget in seconds makes a result depend on the machine and"
            " on what else runs there; no comparison of two runs reads these figures.**"
        ),
        f"**Did not finish: {'; '.join(cut) or 'none'}.**",
    ]
    if untuned:
        text.append(
            "Ended before their first iteration of tuning, so that their renders show the scene"
            f" before the edit: {'; '.join(untuned)}."
        )
    timed = (columns[1], columns[5])
    return Section("Methods with a budget", text, [Table(columns, rows, timed=timed)])


def _limit(cells: Sequence[tuple[str, Any]], name: str) -> float:
    """Mean over scenes of one limit of the cells' budgets, NaN without limits."""
    limits = [(scene, getattr(record.extra.budget, name)) for scene, record in cells]
    return _over_scenes((scene, limit) for scene, limit in limits if limit is not None)


def _seconds(results: Results, probe: str, name: str) -> dict[tuple[Any, ...], dict[str, float]]:
    """Seconds by part of each cell, by (scene, seed, edit)."""
    return {
        (scene, seed, record.extra.name): {
            part: float(record.cost.seconds.get(f"method: {part}") or 0.0) for part in PARTS
        }
        for scene, seed, record in results.records(probe, name)
    }


def _over_scenes(values: Iterable[tuple[str, float]]) -> float:
    """Mean over scenes of the means over their cells, from (scene, value) pairs."""
    by_scene: dict[str, list[float]] = {}
    for scene, value in values:
        by_scene.setdefault(scene, []).append(value)
    return interval(by_scene).mean


def _editing(seconds: Mapping[str, float]) -> float:
    return seconds["source"] + seconds["warp"] + seconds["edit"]


def _mean(values: Iterable[float]) -> float:
    listed = list(values)
    return sum(listed) / len(listed) if listed else math.nan


def _unit(metric: str) -> str:
    if "same_answer" in metric:
        return "share"
    return "dB" if "psnr" in metric else "dE00"
