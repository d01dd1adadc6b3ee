"""Figures of a capture's warps at its tracks, as tracks.json and as a page."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.errors import InputError
from attnwarp.fit import Views
from attnwarp.gaussians import Gaussians
from attnwarp.methods.scene import near_of
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.cost import environment
from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.write import write_files
from attnwarp_eval.files import write_atomic
from attnwarp_eval.tracks.find import Tracks
from attnwarp_eval.tracks.measure import LEAST, OFF, Figure, Pair, measure, summarise

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
    """

    splats: str
    preset: str
    apart: int
    views: str
    pairs: int
    points: int
    angle: float
    figures: dict[str, Figure]


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
                        float(np.median(angle)), summarise(chosen),
                    )
                )  # fmt: skip
    return sorted(rows, key=lambda row: (row.views != "all", row.apart))


def table(rows: Iterable[Row]) -> Table:
    """The figures as a table, with their intervals."""
    cells = [[*_first(row), *(str(row.figures[name]) for name in NAMES)] for row in rows]
    return Table([*COLUMNS, *NAMES.values()], cells)


def short_table(rows: Iterable[Row]) -> Table:
    """Figures for a terminal of 80 columns, without intervals."""
    shown = ("median", "kept", "median_kept", "dropped_off")
    cells = [
        [*_first(row)[:3], *(_plain(row.figures[name].value) for name in shown)] for row in rows
    ]
    return Table([*COLUMNS[:3], *(NAMES[name] for name in shown)], cells)


def _first(row: Row) -> list[str]:
    apart = f"{row.apart}" if row.views == "all" else f"{row.apart}, held out"
    return [row.splats, row.preset, apart, str(row.pairs), str(row.points), f"{row.angle:.1f}"]


def _plain(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.2f}"


class Page:
    """Report of splats fitted to one capture, written as tracks.json and as a page.

    Args:
        folder: output folder.
        views: the capture's cameras and pictures, of the size to measure at.
        tracks: in px of these cameras.
    """

    def __init__(self, folder: Path, views: Views, tracks: Tracks) -> None:
        self.folder, self.views, self.tracks = folder, views, tracks
        self.rows: list[Row] = []

    def add(
        self,
        path: Path,
        splats: Gaussians,
        presets: Sequence[str],
        apart: Sequence[int],
        report: Reporter = SILENT,
    ) -> None:
        """Measure splats under each preset.

        Args:
            path: path of the splats. Its folder names them; views of the folder's ``held_out`` were
                held out of the fit.
            presets: names of the warp's settings.
            apart: distances between the views of a pair.
            report: receiver of progress.

        Raises:
            InputError: no pair of views has enough points in common.
        """
        cameras = list(self.views.cameras)
        label = path.parent.name or path.stem
        held = [
            (path.parent / "held_out" / f"{Path(camera.name).stem}.png").is_file()
            for camera in cameras
        ]
        for name in presets:
            pairs = measure(
                splats, cameras, self.tracks, name, apart=apart, held_out=held,
                near=near_of(cameras, splats), report=report,
            )  # fmt: skip
            if not pairs:
                raise InputError(
                    f"--apart: no pair of views has {LEAST} points in common; take nearer ones"
                )
            self.rows += rows_of(label, name, pairs)

    def write(self, inputs: Mapping[str, Any]) -> list[Path]:
        """Write tracks.json, with the command's inputs, and the page; return their paths."""
        started, camera = self.tracks.started, self.views.cameras[0]
        notes = [
            f"{int((~started).sum())} points in {len(self.views.cameras)} pictures, measured at"
            f" {camera.width} x {camera.height} px."
        ]
        if not started.any():
            notes.append("The fit may have begun from these points.")
        data = {
            "format": FORMAT,
            "inputs": dict(inputs),
            "rows": [without_nan(asdict(row)) for row in self.rows],
            "notes": notes,
            "environment": environment(),
        }
        text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        write_atomic(self.folder / "tracks.json", text.encode())
        page = Report("Warps against tracks", [" ".join(notes)], list(self._sections()))
        return [self.folder / "tracks.json", *write_files(page, self.folder, "tracks")]

    def _sections(self) -> Iterator[Section]:
        yield Section("Figures", tables=[table(self.rows)])
        yield Section("How to read this", [READING, BLIND])
