"""The report of accuracy, accuracy.json and the figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp_eval.canonical_json import without_nan, write_json
from attnwarp_eval.experiments.accuracy.panel import Panel
from attnwarp_eval.statistics.intervals import RATIO_INTERVAL


def write(panels: Sequence[Panel], out: Path) -> list[Path]:
    """Write the report of panels, accuracy.json and the figures; return the files' paths."""
    from attnwarp_eval.cost import environment
    from attnwarp_eval.document import charts
    from attnwarp_eval.document.model import Picture, Report
    from attnwarp_eval.document.write import write_files
    from attnwarp_eval.statistics.intervals import Interval
    from attnwarp_eval.truth.llvm import variant

    out.mkdir(parents=True, exist_ok=True)
    nan = float("nan")
    unmeasured = [panel.scene for panel in panels if not panel.contestants]
    panels = [panel for panel in panels if panel.contestants]

    def point(panel: Panel, k: int) -> tuple[Interval, Interval]:
        base, ratio = float(np.median(panel.contestants[0].seconds)), panel.ratio(k)
        mean, low, high = panel.contestants[k].error
        if mean == 0 and high > 0:
            # Zero wrong points have no place on a logarithmic axis: shown at half a point, with a
            # bar up to the upper bound of the interval.
            mean = 0.5 / panel.contestants[k].more["points"]
        seconds = Interval(
            base * ratio.ratio, base * ratio.low, base * ratio.high, 1, 1, 0, nan, nan
        )
        return seconds, Interval(mean, low, high, 1, 1, 0, nan, nan)

    drawn = []
    for question in TITLES:
        selected = [panel for panel in panels if panel.question == question]
        if not selected:
            continue
        path = out / f"{question}.svg"
        with charts.drawing(path, columns=len(selected)) as axes:
            for ax, panel in zip(axes, selected, strict=True):
                points = {c.name: point(panel, k) for k, c in enumerate(panel.contestants)}
                charts.cost_front(ax, points, x="seconds", y=SHORT[question], title=panel.scene)
        drawn.append((question, path))
    sections = _sections(panels)
    for section in sections:
        section.figures += [
            Picture(path.name, f"{section.title}: error against time")
            for question, path in drawn
            if TITLES[question] == section.title
        ]
    about = environment()
    lead = [
        (
            f"Mitsuba {about['versions']['mitsuba']} as `{variant()}`, Open3D"
            f" {about['versions']['open3d']}, {about['machine']['cores']} cores"
            f" ({about['machine']['arch']})."
        ),
        (
            "All contestants of a scene ran in turn in one process, in an order drawn anew each"
            " round. A ratio is the median over rounds of the ratio to the first row within a"
            f" round; {RATIO_INTERVAL} The row `again` is the first row"
            " against itself: what noise alone does."
        ),
        (
            "The converged picture is made by the plan, with samples of its own. So agreement with"
            " it shows that sampling adds no bias; that the plan drops no light, the rows with"
            " everything on show, and `scenes effects --prove`."
        ),
    ]
    if unmeasured:
        lead.append(
            f"Left out: visibility of {', '.join(unmeasured)}. No point of the middle target faces"
            " the source and falls inside its image."
        )
    report = Report("Error of the truth itself, against time", lead, sections)
    data = {
        "environment": about,
        "variant": variant(),
        "panels": without_nan([asdict(panel) for panel in panels]),
    }
    write_json(out / "accuracy.json", data, sort_keys=False)
    written = write_files(report, out, "accuracy")
    return [out / "accuracy.json", *(path for _, path in drawn), *written]


SHORT = {
    "pictures": "RMS error / mean",
    "depth": "largest relative error",
    "visibility": "not labelled rightly",
}
TITLES = {
    "pictures": "Pictures: samples, plan and variant",
    "depth": "Depth: float32 hits and their refinement",
    "visibility": "Visibility: rays and depth maps",
}


def _sections(panels: Sequence[Panel]) -> list[Any]:
    from scipy import stats

    from attnwarp_eval.document.model import Section, Table
    from attnwarp_eval.document.numbers import bracketed, number, ratio_text

    sections = []
    for question, title in TITLES.items():
        selected = [panel for panel in panels if panel.question == question]
        if not selected:
            continue
        section = Section(title)
        extra = {
            "pictures": ["bias of the mean", "time for the same noise, ratio"],
            "depth": ["median", "99 %", "off by more than 0.1 %"],
            "visibility": ["wrong", "unanswered"],
        }[question]
        for panel in selected:
            rows = []
            for k, c in enumerate(panel.contestants):
                value, low, high = c.error
                error = bracketed(value, *((low, high) if low < high else ()))
                if question == "pictures":
                    half = 100 * c.more["bias_error"] * stats.t.ppf(0.975, len(c.seconds) - 1)
                    more = [
                        f"{100 * c.more['bias']:+.2f} % ± {half:.2f}",
                        "1" if k == 0 else ratio_text(panel.at_equal_error(k)),
                    ]
                elif question == "depth":
                    more = [
                        f"{c.more['median']:.1e}",
                        f"{c.more['p99']:.1e}",
                        f"{100 * c.more['wrong']:.2f} %",
                    ]
                    error = f"{value:.1e}"
                else:
                    more = [f"{100 * c.more[key]:.1f} %" for key in ("wrong", "unanswered")]
                    error = bracketed(*(100 * x for x in c.error), form="{:.1f}".format) + " %"
                times = [
                    number(1000 * float(np.median(c.seconds))),
                    "1" if k == 0 else ratio_text(panel.ratio(k)),
                ]
                rows.append([c.name, error, *more, *times])
            blank = ["–"] * (1 + len(extra))
            rows.append(
                [
                    "again",
                    *blank,
                    number(1000 * float(np.median(panel.again))),
                    ratio_text(panel.ratio(None)),
                ]
            )
            section.tables.append(
                Table(["contestant", panel.unit, *extra, "ms", "time, ratio"], rows, panel.scene)
            )
        sections.append(section)
    return sections
