"""The report of the flow study: how far figures along optical flow are from exact ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from attnwarp_eval.canonical_json import without_nan, write_json
from attnwarp_eval.document.model import Picture, Report, Section, Table
from attnwarp_eval.experiments.flow import PAIRS, SLIP, Row

TITLES = {
    "truth": "truth",
    "one_answer": "one answer",
    "slip": f"{SLIP} px slip",
    "two_answers": "two answers",
}
"""Titles of the pairs in tables."""


def table(rows: Sequence[Row]) -> Table:
    """Mean DeltaE of the edited object, exact, along the flow, and along it at the exact figure's
    pixels; and the flow's own errors in the whole picture.
    """
    columns = ["scene", "yaw", "object px", *TITLES.values()]
    columns += ["EPE median, p95 (px)", "check passes", "not in source"]
    lines = []
    for row in rows:
        cells = [row.scene, f"{row.yaw:g}", f"{row.figures['truth']['consistency.pixels']:g}"]
        for kind in PAIRS:
            figures = row.figures[kind]
            names = ("delta_e", "flow_delta_e", "flow_same_delta_e")
            cells.append(" / ".join(f"{figures[f'consistency.{name}']:.1f}" for name in names))
        cells.append(
            f"{row.flow['consistency.flow_epe_median']:.2f},"
            f" {row.flow['consistency.flow_epe_p95']:.1f}"
        )
        cells += [
            f"{row.flow['consistency.flow_recall']:.0%}",
            f"{row.flow['consistency.flow_false']:.0%}",
        ]
        lines.append(cells)
    caption = (
        "Mean CIEDE2000: exact / along the flow / along the flow at the pixels of the exact figure"
    )
    return Table(columns, lines, caption)


def write(rows: Sequence[Row], out: Path, *, size: int, spp: int) -> list[Path]:
    """Write flow.json, the report and its figures; return the paths of the report.

    Args:
        rows: of :func:`attnwarp_eval.experiments.flow.measure`, of one flow method.
    """
    from attnwarp_eval.cost import environment
    from attnwarp_eval.document.write import write_files

    about = environment()
    lead = [
        (
            "Made by `attnwarp-eval scenes flow --out <this folder>`:"
            f" {', '.join(dict.fromkeys(r.scene for r in rows))}; {size} x {size} px, {spp} samples"
            f" a pixel; flow by OpenCV's {rows[0].method} ({_version(about['versions'], 'opencv')})"
            " between the UNEDITED pictures of two views, the second turned around the scene by"
            " yaw degrees."
        ),
        (
            "The figure is the mean CIEDE2000 of the edited object between the two views, about 1"
            " being just seen. Its exact form compares colours at correspondences known from the"
            " scene; published work takes optical flow for them, where flow there and back agree."
            " The four pairs' consistency is known beforehand: **truth**, the scene unedited, and"
            " **one answer**, a recolouring that is the same in both views, are as consistent as"
            f" can be; **slip** is the second with the target moved by {SLIP} px; **two answers**"
            " has another colour in each view. docs/measuring/metrics.md explains the rest."
        ),
    ]
    far = Section(
        "How far the flow's figure is from the exact one",
        [
            "Of two views that are perfectly consistent, the flow's figure over the exact one: 1 is"
            " right, above it the flow sees disagreement that is not there. Beside it the same at"
            " the pixels of the exact figure, which leaves outlines out; and the flow's figure of"
            " the slipped edit over that of the consistent one: at 1 it cannot tell the two apart."
            " Least and largest over the scenes."
        ],
        [Table(SUMMARY, _summary(rows))],
        [
            Picture(
                _draw_consistency(rows, out).relative_to(out).as_posix(),
                "CIEDE2000 between two views against yaw",
            )
        ],
    )
    wrong = Section(
        "How wrong the flow itself is",
        [
            "Endpoint error over pixels visible in both views away from edges; the share of those"
            " that the check lets pass; and of all that it lets pass, the share that the source"
            " certainly does not show. Whole picture."
        ],
        figures=[
            Picture(
                _draw_flow(rows, out).relative_to(out).as_posix(), "Errors of the flow against yaw"
            )
        ],
    )
    every = Section("Every scene and yaw", tables=[table(rows)])
    report = Report(
        "Consistency along optical flow, against exact correspondences", lead, [far, wrong, every]
    )
    write_json(out / "flow.json", without_nan([asdict(row) for row in rows]), sort_keys=False)
    return write_files(report, out, "report")


SUMMARY = [
    "yaw",
    "truth",
    "one answer",
    "one answer, same pixels",
    "slip over one answer, exact",
    "slip over one answer, flow",
]


def _summary(rows: Sequence[Row]) -> list[list[str]]:
    """Rows by yaw: the least and the largest ratio over the scenes."""

    def value(row: Row, kind: str, name: str) -> float:
        return row.figures[kind][f"consistency.{name}"]

    ratios: list[Callable[[Row], float]] = [
        lambda r: value(r, "truth", "flow_delta_e") / value(r, "truth", "delta_e"),
        lambda r: value(r, "one_answer", "flow_delta_e") / value(r, "one_answer", "delta_e"),
        lambda r: value(r, "one_answer", "flow_same_delta_e") / value(r, "one_answer", "delta_e"),
        lambda r: value(r, "slip", "delta_e") / value(r, "one_answer", "delta_e"),
        lambda r: value(r, "slip", "flow_delta_e") / value(r, "one_answer", "flow_delta_e"),
    ]
    table = []
    for yaw in dict.fromkeys(row.yaw for row in rows):
        cells = [f"{yaw:g}"]
        for ratio in ratios:
            values = [ratio(row) for row in rows if row.yaw == yaw]
            defined = [value for value in values if np.isfinite(value)]
            cells.append(f"{min(defined):.1f} to {max(defined):.1f}" if defined else "undefined")
        table.append(cells)
    return table


def _draw_consistency(rows: Sequence[Row], out: Path) -> Path:
    from attnwarp_eval.document import charts

    scenes = list(dict.fromkeys(row.scene for row in rows))
    path = out / "figures" / "consistency.svg"
    with charts.drawing(path, columns=len(scenes), width=4.0 * len(scenes)) as axes:
        for ax, scene in zip(axes, scenes, strict=True):
            selected = [row for row in rows if row.scene == scene]
            for k, kind in enumerate(PAIRS[1:]):
                for name, style in (("delta_e", "-"), ("flow_delta_e", "--")):
                    ax.plot(
                        [row.yaw for row in selected],
                        [row.figures[kind][f"consistency.{name}"] for row in selected],
                        style,
                        color=charts.PALETTE[k],
                        marker=charts.MARKERS[k],
                        markersize=4,
                        linewidth=1.4,
                        label=f"{TITLES[kind]}, {'exact' if name == 'delta_e' else 'flow'}",
                    )
            ax.set(xlabel="yaw, degrees", ylabel="mean CIEDE2000", yscale="log")
            ax.set_title(scene, loc="left", fontsize=9.5)
        axes[-1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return path


def _draw_flow(rows: Sequence[Row], out: Path) -> Path:
    from attnwarp_eval.document import charts

    scenes = list(dict.fromkeys(row.scene for row in rows))
    path = out / "figures" / "flow.svg"
    panels = {
        "flow_epe_median": "median endpoint error, px",
        "flow_recall": "of the visible, the check passes",
        "flow_false": "of what passes, not in the source",
    }
    with charts.drawing(path, columns=len(panels), width=4.0 * len(panels)) as axes:
        for ax, (name, title) in zip(axes, panels.items(), strict=True):
            for k, scene in enumerate(scenes):
                selected = [row for row in rows if row.scene == scene]
                ax.plot(
                    [row.yaw for row in selected],
                    [row.flow[f"consistency.{name}"] for row in selected],
                    color=charts.PALETTE[k],
                    marker=charts.MARKERS[k],
                    markersize=4,
                    linewidth=1.4,
                    label=scene,
                )
            ax.set(xlabel="yaw, degrees")
            if name == "flow_epe_median":
                ax.set_yscale("log")
            else:
                ax.set_ylim(0, 1)
            ax.set_title(title, loc="left", fontsize=9.5)
        axes[-1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return path


def _version(versions: dict[str, str], start: str) -> str:
    return next(
        (f"{name} {version}" for name, version in versions.items() if name.startswith(start)), start
    )
