"""How good is optical flow in place of exact correspondences, as the field measures consistency?

    python -m attnwarp_eval.experiments.flow --out runs/flow

For each scene and yaw: the exact disagreement of two views and the one along optical flow, on the
edited object, of four pairs of pictures whose consistency is known beforehand: the unedited truth
and an edit with one answer in both views (both as consistent as the scene itself), the same with
the target moved by 2 px, and one with a different answer in each view (as inconsistent as can be).
With ``--out`` a report is written there: report.md with its figures, flow.json, and the pictures of
each pair. The table of docs/metrics.md comes from here; reports/flow is made with
``--no-pictures``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.camera import Camera
from attnwarp_eval.scene.scene import Scene

SCENES = {"bear": "some_colour", "dinosaur": "some_colour", "person": "some_jacket"}
"""Scenes, and an edit of each with several right answers."""

YAWS = (2.0, 5.0, 10.0, 20.0, 30.0, 60.0)

SLIP = 2
"""Pixels by which the target is moved sideways for the pair "slip": an edit whose details are a
little out of place.
"""

PAIRS = ("truth", "one_answer", "slip", "two_answers")
"""What the two views show: the scene unedited; edited with one answer; the same, the target moved
by :data:`SLIP`; the source with one answer, the target with another."""

TITLES = {
    "truth": "truth",
    "one_answer": "one answer",
    "slip": f"{SLIP} px slip",
    "two_answers": "two answers",
}
"""What tables call them."""


@dataclass(frozen=True)
class Row:
    """One scene, yaw and flow method; keys are those of
    :data:`attnwarp_eval.metrics.registry.METRICS`.

    Attributes:
        figures: by what the two views show (:data:`PAIRS`), exact figures, flow figures
            (``flow_``), what separates them (``flow_gap_``), and flow figures at the pixels of the
            exact ones (``flow_same_``).
        flow: the endpoint error of the flow and its check, whole picture.
    """

    scene: str
    yaw: float
    method: str
    figures: dict[str, dict[str, float]]
    flow: dict[str, float]


def turned(scene: Scene, yaw: float) -> Camera:
    """The scene's source camera, taken around the point that it looks at by ``yaw`` degrees, at the
    same height.
    """
    spec = scene.spec.cameras
    angle = np.radians(spec.source.yaw + yaw)
    position = (
        spec.look_at[0] + spec.radius * float(np.cos(angle)),
        spec.look_at[1] + spec.radius * float(np.sin(angle)),
        float(scene.source.position[2]),
    )
    return Camera.look_at(
        position,
        spec.look_at,
        width=spec.size[0],
        height=spec.size[1],
        fov_y=spec.fov,
        name=f"turned{yaw:g}",
    )


def study(
    name: str,
    edit: str,
    *,
    size: int,
    spp: int,
    yaws: Sequence[float],
    method: Any = "dis",
    keep: Callable[[str, Any], object] | None = None,
) -> Iterator[Row]:
    """The rows of one scene.

    Args:
        name: of the scene, or its path.
        edit: one with at least two answers, which changes objects and not the light.
        size: of the pictures in px.
        spp: samples a pixel.
        yaws: degrees from the source.
        method: of :func:`attnwarp_eval.metrics.optical_flow`.
        keep: given names and (H, W, 3) sRGB pictures to look at.

    Raises:
        ValueError: an edit with one result.
    """
    from attnwarp_eval import metrics
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth import Geometry, appearance, to_srgb, two_view
    from attnwarp_eval.truth.edits import edit_mask

    scene = load_scene(name).with_size(size, size)
    answers = [one.name for one in scene.edit(edit).answers]
    if len(answers) < 2:
        raise ValueError(
            f"edit {edit!r} of {scene.name!r}: got one result, expected at least two answers"
        )
    worlds = {"truth": scene, **{one: scene.edited(edit, one) for one in (answers[0], answers[-1])}}
    geometry = Geometry(scene)

    def picture(world: str, camera: Camera) -> Any:
        return to_srgb(appearance(worlds[world], camera, spp=spp))

    source = {world: picture(world, scene.source) for world in ("truth", answers[0])}
    for yaw in yaws:
        camera = turned(scene, yaw)
        pair = two_view(geometry, scene.source, camera)
        target = {world: picture(world, camera) for world in worlds}
        # One object for all pairs, that of the first answer: answers may change others besides.
        mask = edit_mask(scene, edit, pair.hits, answers[0])
        flow = metrics.optical_flow(source["truth"], target["truth"], method)
        shown = {
            "truth": (source["truth"], target["truth"]),
            "one_answer": (source[answers[0]], target[answers[0]]),
            "slip": (source[answers[0]], np.roll(target[answers[0]], SLIP, axis=1)),
            "two_answers": (source[answers[0]], target[answers[-1]]),
        }
        figures = {}
        for kind, (one, other) in shown.items():
            exact = metrics.cross_view(one, other, pair, mask=mask)
            by_flow = metrics.flow_consistency(one, other, flow, mask=mask)
            same = metrics.flow_consistency(one, other, flow, mask=exact.counted)
            figures[kind] = {
                **exact.figures(),
                **by_flow.figures("flow_"),
                **same.figures("flow_same_"),
                **metrics.approximation_error(exact, by_flow),
            }
            if keep is not None:
                keep(
                    f"{scene.name}-{yaw:g}-{kind}",
                    _sheet(one, other, exact.delta_e, by_flow.delta_e),
                )
        yield Row(scene.name, yaw, method, figures, metrics.flow_error(flow, pair))


def _sheet(source: Any, target: Any, exact: Any, flow: Any) -> Any:
    """Source, target, exact DeltaE and DeltaE along the flow, side by side: black 0, white 40 and
    beyond, blue not counted.
    """
    maps = []
    for delta_e in (exact, flow):
        grey = np.repeat(np.clip(np.nan_to_num(delta_e) / 40, 0, 1)[..., None], 3, axis=-1)
        maps.append(np.where(np.isnan(delta_e)[..., None], [0.1, 0.15, 0.35], grey))
    return np.concatenate([source, target, *maps], axis=1)


def table(rows: Sequence[Row]) -> str:
    """Markdown: mean DeltaE of the edited object, exact, along the flow, and along it at the exact
    figure's pixels; and the flow's own errors in the whole picture.
    """
    columns, cells = _cells(rows)
    lines = [columns, ["---"] * len(columns), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cells(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """The table's columns, and its rows as text."""
    columns = ["scene", "yaw", "object px", *TITLES.values()]
    columns += ["EPE median, p95 (px)", "check passes", "not in source"]
    table = []
    for row in rows:
        cells = [row.scene, f"{row.yaw:g}", f"{row.figures['truth']['consistency.pixels']:g}"]
        for kind in PAIRS:
            found = row.figures[kind]
            names = ("delta_e", "flow_delta_e", "flow_same_delta_e")
            cells.append(" / ".join(f"{found[f'consistency.{name}']:.1f}" for name in names))
        cells.append(
            f"{row.flow['consistency.flow_epe_median']:.2f},"
            f" {row.flow['consistency.flow_epe_p95']:.1f}"
        )
        cells += [
            f"{row.flow['consistency.flow_recall']:.0%}",
            f"{row.flow['consistency.flow_false']:.0%}",
        ]
        table.append(cells)
    return columns, table


def write_report(rows: Sequence[Row], out: Path, *, size: int, spp: int) -> list[Path]:
    """Write report.md and its figures.

    Args:
        rows: of :func:`study`, of one flow method.
        out: folder.
        size, spp: of the pictures, as the report says them.
    """
    from attnwarp_eval.cost import environment
    from attnwarp_eval.document.model import Picture, Report, Section, Table
    from attnwarp_eval.document.write import markdown

    about = environment()
    lead = [
        (
            "Made by `python -m attnwarp_eval.experiments.flow --out <this folder>`:"
            f" {', '.join(dict.fromkeys(r.scene for r in rows))}; {size} x {size} px, {spp} samples"
            f" a pixel; flow by OpenCV's {rows[0].method} ({_version(about['versions'], 'opencv')})"
            " between the UNEDITED pictures of two views, the second turned around the scene by"
            " yaw degrees."
        ),
        (
            "The figure is the mean CIEDE2000 of the edited object between the two views, about 1"
            " being just seen. Its exact form compares colours at correspondences known from the"
            " scene; published work takes optical flow for them, where flow there and back agree."
            " The four pairs' consistency is known beforehand: *truth*, the scene unedited, and"
            " *one answer*, a recolouring that is the same in both views, are as consistent as can"
            f" be; *slip* is the second with the target moved by {SLIP} px; *two answers* has"
            " another colour in each view. docs/metrics.md explains the rest."
        ),
    ]
    columns, cells = _cells(rows)
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
    caption = (
        "Mean CIEDE2000: exact / along the flow / along the flow at the pixels of the exact figure"
    )
    every = Section("Every scene and yaw", tables=[Table(columns, cells, caption)])
    report = Report(
        "Consistency along optical flow, against exact correspondences", lead, [far, wrong, every]
    )
    path = out / "report.md"
    path.write_text(markdown(report), encoding="utf-8")
    return [path]


SUMMARY = [
    "yaw",
    "truth",
    "one answer",
    "one answer, same pixels",
    "slip over one answer, exact",
    "slip over one answer, flow",
]


def _summary(rows: Sequence[Row]) -> list[list[str]]:
    """By yaw: the least and the largest ratio over the scenes."""

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
            found = [
                one for row in rows if row.yaw == yaw for one in [ratio(row)] if np.isfinite(one)
            ]
            cells.append(f"{min(found):.1f} to {max(found):.1f}" if found else "undefined")
        table.append(cells)
    return table


def _draw_consistency(rows: Sequence[Row], out: Path) -> Path:
    from attnwarp_eval.document import figures

    scenes = list(dict.fromkeys(row.scene for row in rows))
    path = out / "figures" / "consistency.svg"
    with figures.drawing(path, columns=len(scenes), width=4.0 * len(scenes)) as axes:
        for ax, scene in zip(axes, scenes, strict=True):
            mine = [row for row in rows if row.scene == scene]
            for k, kind in enumerate(PAIRS[1:]):
                for name, style in (("delta_e", "-"), ("flow_delta_e", "--")):
                    ax.plot(
                        [row.yaw for row in mine],
                        [row.figures[kind][f"consistency.{name}"] for row in mine],
                        style,
                        color=figures.PALETTE[k],
                        marker=figures.MARKERS[k],
                        markersize=4,
                        linewidth=1.4,
                        label=f"{TITLES[kind]}, {'exact' if name == 'delta_e' else 'flow'}",
                    )
            ax.set(xlabel="yaw, degrees", ylabel="mean CIEDE2000", yscale="log")
            ax.set_title(scene, loc="left", fontsize=9.5)
        axes[-1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return path


def _draw_flow(rows: Sequence[Row], out: Path) -> Path:
    from attnwarp_eval.document import figures

    scenes = list(dict.fromkeys(row.scene for row in rows))
    path = out / "figures" / "flow.svg"
    panels = {
        "flow_epe_median": "median endpoint error, px",
        "flow_recall": "of the visible, the check passes",
        "flow_false": "of what passes, not in the source",
    }
    with figures.drawing(path, columns=len(panels), width=4.0 * len(panels)) as axes:
        for ax, (name, title) in zip(axes, panels.items(), strict=True):
            for k, scene in enumerate(scenes):
                mine = [row for row in rows if row.scene == scene]
                ax.plot(
                    [row.yaw for row in mine],
                    [row.flow[f"consistency.{name}"] for row in mine],
                    color=figures.PALETTE[k],
                    marker=figures.MARKERS[k],
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m attnwarp_eval.experiments.flow",
        description="Consistency of two views, exact and along optical flow.",
    )
    parser.add_argument(
        "--scenes", nargs="+", choices=sorted(SCENES), default=list(SCENES), help="default: all"
    )
    parser.add_argument(
        "--yaws", nargs="+", type=float, default=list(YAWS), help="degrees from the source"
    )
    parser.add_argument("--size", type=int, default=256, help="of the pictures in px (default 256)")
    parser.add_argument("--spp", type=int, default=32, help="samples a pixel (default 32)")
    parser.add_argument(
        "--method",
        choices=("dis", "farneback"),
        default="dis",
        help="of OpenCV's flow (default dis)",
    )
    parser.add_argument(
        "--out", type=Path, help="folder for report.md, its figures, flow.json and pictures"
    )
    parser.add_argument(
        "--no-pictures", action="store_true", help="leave out the picture of each pair"
    )
    options = parser.parse_args(arguments)

    def keep(name: str, image: Any) -> None:
        import cv2

        pixels = np.round(255 * image[..., ::-1]).astype(np.uint8)
        if not cv2.imwrite(str(options.out / f"{name}.png"), pixels):
            raise OSError(f"{options.out / name}.png: could not be written")

    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for name in options.scenes:
        for row in study(
            name,
            SCENES[name],
            size=options.size,
            spp=options.spp,
            yaws=options.yaws,
            method=options.method,
            keep=keep if options.out and not options.no_pictures else None,
        ):
            rows.append(row)
    print(table(rows))
    if options.out:
        (options.out / "flow.json").write_text(
            json.dumps(_plain([asdict(row) for row in rows]), indent=1) + "\n"
        )
        for path in write_report(rows, options.out, size=options.size, spp=options.spp):
            print(path)


def _plain(value: Any) -> Any:
    """With null for NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and np.isnan(value) else value


if __name__ == "__main__":
    main()
