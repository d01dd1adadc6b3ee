"""Measurement of a run: metrics, code, machine, seconds; and failed cells."""

from __future__ import annotations

from typing import Any

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results

STAGES = ("setup", "truth", "splats", "method", "sample", "checks", "pictures")


def failures(results: Results) -> list[Section]:
    """The section of failed cells, none without failures."""
    if not results.failures:
        return []
    rows = [[f.scene, f.variant, f.probe, f.error] for f in results.failures]
    text = ["These cells are missing from every table above. Run the study again to retry them."]
    return [Section("Failed cells", text, [Table(["scene", "variant", "probe", "error"], rows)])]


def measured(results: Results, timings: bool) -> Section:
    """The section on the meaning of the figures and the environment of their computation."""
    metrics = {
        metric.name: metric
        for cell in results.cells
        if cell.record
        for view in cell.record.views
        for metric in map(probe(cell.probe).metric, view.metrics)
    }
    rows = [
        [m.name, m.unit, m.direction, str(m.version), m.description]
        for _, m in sorted(metrics.items())
        if not m.is_count
    ]
    text = [
        (
            "Behind a metric's name may stand a region (`interior`, `edge`: within 2 px of a depth"
            " or object edge) or the size of a feature grid. Every value of every view is in"
            " `results.jsonl`."
        ),
    ]
    records = results.all_records()
    if records:
        text += _environments(records)
        if timings:
            total = {
                stage: sum(record.cost.seconds.get(stage) or 0.0 for record in records)
                for stage in STAGES
            }
            peak = max(record.cost.peak_memory_mb for record in records)
            text.append(
                "Seconds over all cells: "
                + ", ".join(f"{stage} {number(seconds)}" for stage, seconds in total.items())
                + f". Peak memory {peak:.0f} MiB."
            )
    return Section(
        "How it was measured",
        text,
        [Table(["metric", "unit", "better", "version", "meaning"], rows, glossary=True)],
    )


def _environments(records: list[Record[Any]]) -> list[str]:
    """Every state of code, versions and machine that computed cells of this run, with the number of
    cells.
    """
    counted: dict[str, int] = {}
    states = {(record.environment.revision, record.environment.source) for record in records}
    for record in records:
        environment = record.environment
        revision = environment.revision
        code = f"revision `{revision[:12]}`" if revision else "an installed copy"
        if environment.dirty:
            code += " with local changes"
        # One revision has several source hashes if plugins changed.
        several = sum(other == revision for other, _ in states) > 1
        if environment.source and (environment.dirty or not revision or several):
            code += f" (source `{environment.source[:12]}`)"
        versions = ", ".join(f"{name} {version}" for name, version in environment.versions.items())
        machine = environment.machine
        computer = f"{machine['system']} {machine['arch']}, {machine['cores']} cores"
        described = f"{code}; {versions}; {computer}"
        counted[described] = counted.get(described, 0) + 1
    if len(counted) == 1:
        return [f"Computed with {next(iter(counted))}."]
    lines = [
        f"{count} cell{'s' if count > 1 else ''} with {described}"
        for described, count in sorted(counted.items(), key=lambda x: -x[1])
    ]
    return [
        "**The cells of this run were computed with more than one state of code or machine:** "
        + "; ".join(lines)
        + "."
    ]
