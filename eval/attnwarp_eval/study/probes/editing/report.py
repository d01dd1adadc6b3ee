"""Report of edited scenes: the source edits, the editor's abilities, and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from statistics import median
from typing import Any, ClassVar

from attnwarp_eval.document.model import Grid, Section, Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.statistics.intervals import over_scenes
from attnwarp_eval.study.probe_report import (
    Layout,
    ProbeReport,
    in_degrees,
    register_report,
    views_of,
)
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.encoders import encoders_named
from attnwarp_eval.study.shared.method_run import is_alone


@register_report
class EditingReport(ProbeReport):
    """Agreement, fidelity and seconds of edits by variant."""

    name = "editing"
    measures = "edits of scenes against true pictures of the edit"
    tabulates_all = True
    columns: ClassVar[Mapping[str, str]] = {
        "shows the source's answer": "multiview.same_answer.edit",
        "... where the source saw it": "multiview.same_answer.edit_seen",
        "disagreement above floor, dE00": "multiview.delta_e_above.edit_inside",
        "... of neighbours": "multiview.delta_e_above.edit_next",
        "disagreement in renders, dE00": "multiview.delta_e_above.render_inside",
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

    def sections(self, results: Results, layout: Layout) -> Iterator[Section]:
        """Sections on the source edits and the editor's abilities."""
        if not results.finished(self.name):
            return
        yield source_edits(results, self.name)
        able = abilities(results, self.name)
        spec = results.finished(self.name)[0][1].spec
        if "encoders" in spec:
            yield published(results, self.name)
            able.text.append(encoders_named(results.study, spec))
        yield able

    def gallery(self, results: Results) -> Section | None:
        """Edited views side by side."""
        return side_by_side(results, self.name)


def abilities(results: Results, probe: str) -> Section:
    """Section on the editor's success in the source view, and in every view alone."""
    names = controls(results, probe)
    section = Section("What the editor can do", folded=True)
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
    section.tables = [Table(columns, rows)]
    return section


def source_edits(results: Results, probe: str) -> Section:
    """Section on the number of source edits that succeeded, by variants with equal numbers."""
    counts: dict[tuple[int, int], list[str]] = {}
    for name in results.study.variants:
        if own := [record for _, _, record in results.records(probe, name)]:
            done = sum(record.extra.source.done for record in own)
            counts.setdefault((done, len(own)), []).append(name)
    told = "; ".join(f"{done} of {of}: {', '.join(n)}" for (done, of), n in counts.items())
    text = f"Only edits whose source view shows a right answer have figures. Done: {told}."
    return Section("Source edits", [text])


PUBLISHED: Mapping[str, str] = {
    "Edit PSNR, dB": "image.psnr.edit_render",
    "CLIP direction": "embedding.clip_directional.render",
    "CLIP image": "embedding.clip_image.render",
    "DINO image": "embedding.dino_image.render",
}
"""Figures of the paper's table of methods, by column."""


def published(results: Results, probe: str) -> Section:
    """Section on the figures that papers report, by edit and variant, without verdicts."""
    text = (
        "Described, without verdicts; rows stand on different scenes, so compare none directly."
        " Edit PSNR holds renders against the edited views, so it rewards edits that change"
        " little, and blur. CLIP and DINO look at one view, so they see no disagreement. Which"
        " figure can be believed: docs/measuring/which-metric. Seconds are of one edit, medians of"
        " one pass."
    )
    tables = [_published(own, probe, edit) for edit, own in results.by_edit(probe).items()]
    return Section("Figures that papers report", [text], tables)


def _published(results: Results, probe: str, edit: str) -> Table:
    rows = []
    for name in results.study.variants:
        own = [record for _, _, record in results.records(probe, name)]
        if not own:
            continue
        costs = [record.cost for record in own]
        network = [cost.counters.get("network_rows", 0) for cost in costs]
        seconds = [s for cost in costs if (s := cost.seconds.get("whole")) is not None]
        means = [over_scenes(results.views(probe, name, key)) for key in PUBLISHED.values()]
        rows.append([
            name,
            str(max(mean.scenes for mean in means)),
            *(spread(replace(mean, undefined=0)) for mean in means),
            number(sum(network) / len(network)),
            number(median(seconds)) if seconds else "–",
        ])  # fmt: skip
    columns = ["variant", "scenes", *PUBLISHED, "rows through the network", "seconds"]
    return Table(columns, rows, edit, timed=("seconds",))


def controls(results: Results, probe: str) -> list[str]:
    """Measured variants that edit each view alone; without any, the first measured
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
    return Section("Edited views side by side", text, grids=grids, folded=True)


def _grid(caption: str, methods: Mapping[str, Record[EditResult]]) -> Grid:
    """Pictures of one edit, by method and view."""
    files = {
        name: {(p.content, p.view.rpartition("/")[2]): p.path for p in record.pictures}
        for name, record in methods.items()
    }
    views = list(dict.fromkeys(view for own in files.values() for _, view in own))
    heads = [SOURCE, *in_degrees(views, views_of(methods.values()))]

    def row(label: str, name: str, content: str, source: str = "") -> tuple[str, list[str | None]]:
        of = files[name]
        first = next((path for (content, _), path in of.items() if content == source), None)
        return label, [first, *(of.get((content, view)) for view in views)]

    rows = [row("before", next(iter(files)), "before")]
    truths: dict[tuple[str, ...], list[str]] = {}
    for name, record in methods.items():
        undone = "" if record.comparable else f" {UNDONE}"
        rows.append(row(name + undone, name, "edited", "source-edit"))
        if truth := tuple(p.sha256 for p in record.pictures if p.content == "truth"):
            truths.setdefault(truth, []).append(name)
    for names in truths.values():
        label = "truth" if len(truths) == 1 else f"truth: {', '.join(names)}"
        rows.append(row(label, names[0], "truth"))
    return Grid.of(caption, heads, rows)
