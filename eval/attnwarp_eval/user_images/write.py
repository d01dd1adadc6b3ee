"""Metrics of a user's pictures as JSON, as Markdown and as a table on the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.write import terminal, write_files
from attnwarp_eval.files import write_atomic
from attnwarp_eval.metrics.registry import Metric, metric
from attnwarp_eval.user_images.measure import Measured, Row, figures, natural

if TYPE_CHECKING:
    import rich.table

FORMAT = 1
"""Version of metrics.json."""

_TITLE = "Metrics of the edited scene"

_INPUTS = (
    "renders",
    "edited",
    "originals",
    "source_edit",
    "masks",
    "prompt",
    "source_prompt",
    "poses",
    "ply",
    "depth",
)

_READING = (
    "Pictures are read as sRGB in [0, 1]: 8 bits over 255, 16 bits over 65535, grey as three equal"
    " channels, transparent pixels over the background; a picture is turned as its EXIF tag asks."
)


def to_dict(measured: Measured) -> dict[str, Any]:
    """metrics.json: NaN is null, an infinite PSNR is "inf"."""
    from attnwarp_eval.cost import environment

    inputs = measured.inputs
    return {
        "format": FORMAT,
        "inputs": {
            **{
                name: None if getattr(inputs, name) is None else str(getattr(inputs, name))
                for name in _INPUTS
            },
            "background": list(inputs.background),
            "reading": _READING,
        },
        "metrics": {
            row.key: {
                "title": row.title,
                "value": _number(row.value),
                "unit": _spec(row).unit,
                "direction": _spec(row).direction,
                "version": _spec(row).version,
                "encoder": None if row.encoder is None else measured.encoders[row.encoder].name,
                "n": len(row.views) - len(row.undefined),
                "undefined": row.undefined,
                "identical": row.identical,
                "views": {name: _number(value) for name, value in row.views.items()},
            }
            for row in measured.rows
        },
        "not_computed": measured.missing,
        "encoders": {kind: about.to_dict() for kind, about in measured.encoders.items()},
        "unpaired": measured.unpaired,
        "notes": measured.notes,
        "environment": environment(),
    }


def to_json(measured: Measured) -> str:
    """The text of metrics.json."""
    return json.dumps(to_dict(measured), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def report(measured: Measured) -> Report:
    """Report of the figures."""
    lists = {
        "Not computed": [f"{what}: {why}" for what, why in measured.missing.items()],
        "Pictures without a partner": measured.unpaired,
        "Notes": [*measured.notes, _READING],
    }
    sections = [Section("Figures", tables=[_overview(measured)])]
    sections += [Section(title, [_list(items)]) for title, items in lists.items() if items]
    if measured.encoders:
        sections.append(Section("Encoders", tables=[_encoders(measured)]))
    if measured.rows:
        sections.append(Section("View by view", tables=[_by_view(measured)]))
    inputs = {name: getattr(measured.inputs, name) for name in _INPUTS}
    lead = _list(
        f"{name.replace('_', ' ')}: {value}" for name, value in inputs.items() if value is not None
    )
    return Report(_TITLE, [lead], sections)


def table(measured: Measured) -> rich.table.Table:
    """The figures, for a terminal; encoders by their kind, since the names of real ones are
    long."""
    overview = _overview(measured)
    rows = [cells[:5] for cells in overview.rows]
    return terminal(Table(overview.columns[:5], rows, _TITLE))


def write(measured: Measured, folder: Path) -> list[Path]:
    """Write metrics.json and the report, over older ones; return their paths."""
    write_atomic(folder / "metrics.json", to_json(measured).encode())
    return [folder / "metrics.json", *write_files(report(measured), folder, "metrics")]


def _overview(measured: Measured) -> Table:
    rows = []
    for row in measured.rows:
        encoder = "" if row.encoder is None else measured.encoders[row.encoder].name
        undefined = len(row.undefined)
        views = len(row.views) - undefined
        direction = _spec(row).direction
        rows.append(
            [row.title, _value(row, row.value), str(views), str(undefined), direction, encoder]
        )
    rows += [[title, "not computed", "0", "", "", ""] for title in measured.missing]
    return Table(["figure", "value", "views", "undefined", "better", "encoder"], rows)


def _encoders(measured: Measured) -> Table:
    rows = [
        [a.name, kind, a.source, a.weights_sha256, a.preprocessing]
        for kind, a in sorted(measured.encoders.items())
    ]
    return Table(["name", "kind", "source", "SHA-256 of the weights", "pictures"], rows)


def _by_view(measured: Measured) -> Table:
    own = [row for row in measured.rows if row.key != "edit.psnr_pooled"]
    names = sorted({name for row in own for name in row.views}, key=natural)
    rows = [
        [_line(name), *(_value(row, row.views[name]) if name in row.views else "" for row in own)]
        for name in names
    ]
    titles = {figure.key: figure.title for figure in figures()}
    return Table(["view", *(titles.get(row.key, row.title) for row in own)], rows)


def _spec(row: Row) -> Metric:
    return metric(row.key)


def _value(row: Row, value: float) -> str:
    """Format a value with the usual digits: 3 decimals, 4 for a distance."""
    if math.isnan(value):
        return "identical" if row.identical and not row.undefined else "undefined"
    if math.isinf(value):
        return "inf (identical)"
    if row.encoder == "perceptual":
        return f"{value:.4f}"
    return f"{value:.3f} dB" if _spec(row).unit == "dB" else f"{value:.3f}"


def _number(value: float) -> Any:
    """Number as JSON: NaN is null, and an infinite PSNR, of equal pictures, is "inf"."""
    return "inf" if math.isinf(value) else without_nan(value)


def _list(items: Iterable[str]) -> str:
    return "\n".join(f"- {_line(item)}" for item in items)


def _line(text: str) -> str:
    """Join text to one line, since file names may have several."""
    return " ".join(text.split())
