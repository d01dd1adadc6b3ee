"""Figures of a capture's warps at its tracks, as tracks.json and as a page."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.io.picture import encode_picture
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.cost import environment
from attnwarp_eval.document.model import Gallery, Picture, Report, Section, Table
from attnwarp_eval.document.write import write_files
from attnwarp_eval.files import write_atomic
from attnwarp_eval.tracks.find import Tracks
from attnwarp_eval.tracks.measure import OFF, Figure, Pair, summarise

FORMAT = 1
"""Version of tracks.json."""

READING = (
    "A point of a track is an image point that structure from motion found again in other pictures."
    " `error` is the distance in the source picture between where the warp takes the target's point"
    f" and where the track has it. `off` are points beyond {OFF:g} px, or where the splats have no"
    " depth. `floor` is the same distance for the track's own 3D point: no warp can be judged more"
    " finely. `flat` is a warp whose depth is one plane, which a figure that sees depth must put"
    " far above. Intervals are of 95 %, over target pictures."
)

BLIND = (
    "Tracks are points with texture that both pictures show. They say what a mask drops of"
    " those, and nothing of hidden surface that a mask accepts. Poses and pictures are those that"
    " the splats were fitted to."
)

COLUMNS = ["splats", "preset", "apart", "pairs", "points", "angle"]

NAMES = {
    "median": "error, px", "kept": "kept", "median_kept": "of kept, px", "off": "off",
    "dropped_off": "off, dropped", "floor": "floor, px", "flat": "flat, px",
}  # fmt: skip
"""Columns of the :data:`attnwarp_eval.tracks.measure.FIGURES`."""


@dataclass(frozen=True)
class Row:
    """Figures of the pairs of one distance.

    Attributes:
        splats, preset: name of the splats, and of the warp's settings.
        apart: distance between the views of a pair, in the cameras' order.
        views: "all", or "held out" for pairs with a held-out view.
        pairs, points: numbers of pairs and points.
        angle: median degrees between the rays of a point.
        figures: see :data:`attnwarp_eval.tracks.measure.FIGURES`.
        truth: figures from exact geometry; empty without it.
    """

    splats: str
    preset: str
    apart: int
    views: str
    pairs: int
    points: int
    angle: float
    figures: dict[str, Figure]
    truth: dict[str, float]


def rows_of(splats: str, preset: str, pairs: Sequence[Pair]) -> list[Row]:
    """A row for each distance; with held-out views, one more for pairs with one."""
    rows = []
    for apart in dict.fromkeys(pair.apart for pair in pairs):
        alike = [pair for pair in pairs if pair.apart == apart]
        for views, chosen in (
            ("all", alike),
            ("held out", [pair for pair in alike if pair.held_out]),
        ):
            if chosen:
                angle = np.concatenate([pair.angle for pair in chosen])
                rows.append(
                    Row(
                        splats, preset, apart, views, len(chosen), len(angle),
                        float(np.median(angle)), summarise(chosen), _truth_of(chosen),
                    )
                )  # fmt: skip
    return sorted(rows, key=lambda row: (row.views != "all", row.apart))


def _truth_of(pairs: Sequence[Pair]) -> dict[str, float]:
    known = [(pair, pair.truth) for pair in pairs if pair.truth is not None]
    if not known:
        return {}
    errors = np.concatenate([truth.error for _, truth in known])
    kept = np.concatenate([pair.kept for pair, _ in known])
    visible = np.concatenate([truth.visible for _, truth in known])
    off = visible & ~(errors <= OFF)
    return {
        "median": float(np.nanmedian(errors[visible])),
        "off": float(off[visible].mean()),
        "dropped_off": float(1 - kept[off].mean()) if off.any() else float("nan"),
        "visible": float(visible.mean()),
        "median_everywhere": float(np.nanmedian(np.concatenate([t.errors for _, t in known]))),
        "kept_everywhere": float(np.nanmean([t.kept for _, t in known])),
        "hidden_accepted": float(np.nanmean([t.accepted for _, t in known])),
    }


def write(
    rows: Sequence[Row],
    pictures: Mapping[str, Path],
    inputs: Mapping[str, Any],
    notes: Sequence[str],
    folder: Path,
) -> list[Path]:
    """Write tracks.json and the page; return their paths, the page at the end.

    Args:
        rows: figures.
        pictures: captions and files below ``folder``, see :func:`draw`.
        inputs: names and values of the command's inputs.
        notes: sentences about this capture.
        folder: output folder.
    """
    data = {
        "format": FORMAT,
        "inputs": dict(inputs),
        "rows": [without_nan(asdict(row)) for row in rows],
        "notes": list(notes),
        "environment": environment(),
    }
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    write_atomic(folder / "tracks.json", text.encode())
    return [
        folder / "tracks.json",
        *write_files(document(rows, pictures, notes, folder), folder, "tracks"),
    ]


def document(
    rows: Sequence[Row], pictures: Mapping[str, Path], notes: Sequence[str], folder: Path
) -> Report:
    """Report of the figures."""
    sections = [Section("Figures", tables=[table(rows)])]
    exact = [row for row in rows if row.truth]
    if exact:
        names = {
            "median": "error, px", "off": "off", "dropped_off": "dropped of off",
            "visible": "of points visible", "median_everywhere": "error of all visible pixels",
            "kept_everywhere": "kept of all visible", "hidden_accepted": "hidden accepted",
        }  # fmt: skip
        cells = [[*_first(row), *(_plain(row.truth[name]) for name in names)] for row in exact]
        sections.append(
            Section(
                "What exact geometry says",
                ["The same points against exact geometry, then every pixel."],
                [Table([*COLUMNS, *names.values()], cells)],
            )
        )
    if pictures:
        shown = [
            Picture(path.relative_to(folder).as_posix(), text) for text, path in pictures.items()
        ]
        sections.append(
            Section(
                "Points of a pair",
                [
                    "Green within 1 px, yellow within 2, red beyond; a ring where the mask drops"
                    " the point."
                ],
                gallery=Gallery([("", shown)]),
            )
        )
    sections.append(Section("How to read this", [READING, BLIND]))
    return Report("Warps against tracks", [" ".join(notes)] if notes else [], sections)


def table(rows: Iterable[Row]) -> Table:
    """The figures as a table, with their intervals."""
    return Table(
        [*COLUMNS, *NAMES.values()],
        [[*_first(row), *(str(row.figures[name]) for name in NAMES)] for row in rows],
    )


def short_table(rows: Iterable[Row]) -> Table:
    """The figures without intervals, for a terminal."""
    return Table(
        ["splats", "preset", "apart", "points", *NAMES.values()],
        [
            [
                *(_first(row)[i] for i in (0, 1, 2, 4)),
                *(_plain(row.figures[name].value) for name in NAMES),
            ]
            for row in rows
        ],
    )


def _first(row: Row) -> list[str]:
    apart = f"{row.apart}" if row.views == "all" else f"{row.apart}, held out"
    return [row.splats, row.preset, apart, str(row.pairs), str(row.points), f"{row.angle:.1f}"]


def _plain(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.2f}"


def draw(
    pairs: Sequence[Pair], tracks: Tracks, image: np.ndarray[Any, Any], target: int, path: Path
) -> None:
    """Draw the target's picture with its points, coloured by their error.

    Args:
        pairs: pairs of the target; the first is drawn.
        tracks: in px of the target's camera.
        image: (H, W, 3) float sRGB in [0, 1] of the target.
        target: index of the target's camera.
        path: path of the PNG.
    """
    import cv2

    pair = next(pair for pair in pairs if pair.target == target)
    scale = max(1, round(512 / max(image.shape[:2])))
    large = np.repeat(np.repeat(image[..., :3], scale, axis=0), scale, axis=1)
    canvas = np.ascontiguousarray(np.round(255 * large).astype(np.uint8))
    _, at = tracks.shared(pair.source, target)
    for xy, error, kept in zip(tracks.xy[at], pair.error, pair.kept, strict=True):
        color = (40, 200, 60) if error <= 1 else (250, 210, 30) if error <= OFF else (235, 40, 40)
        center = tuple(int(v) for v in np.round(xy * scale))
        cv2.circle(canvas, center, 3, color, -1 if kept else 1, cv2.LINE_AA)
    write_atomic(path, encode_picture(canvas / 255))
