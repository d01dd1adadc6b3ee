"""What was measured on a person's pictures, as JSON, as Markdown and as a table on the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.files import write_atomic
from attnwarp_eval.metrics.registry import Metric, metric
from attnwarp_eval.user_images.measure import Measured, Row, natural

if TYPE_CHECKING:
    from rich.table import Table

FORMAT = 1
"""Version of metrics.json."""

_READING = (
    "Pictures are read as sRGB in [0, 1]: 8 bits over 255, 16 bits over 65535, grey as three equal"
    " channels, transparent pixels over the background; tags that ask for a turned picture are not"
    " followed."
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
                for name in (
                    "renders",
                    "edited",
                    "originals",
                    "source_edit",
                    "masks",
                    "prompt",
                    "source_prompt",
                )
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


def to_markdown(measured: Measured) -> str:
    """The text of metrics.md."""
    inputs = measured.inputs
    lines = ["# Metrics of the edited scene", ""]
    for name in (
        "renders",
        "edited",
        "originals",
        "source_edit",
        "masks",
        "prompt",
        "source_prompt",
    ):
        value = getattr(inputs, name)
        if value is not None:
            lines.append(f"- {name.replace('_', ' ')}: {_cell(str(value))}")
    lines += [
        "",
        *_grid(["figure", "value", "views", "undefined", "better", "encoder"], _overview(measured)),
    ]
    for title, items in (
        ("Not computed", [f"{what}: {why}" for what, why in measured.missing.items()]),
        ("Pictures without a partner", measured.unpaired),
        ("Notes", [*measured.notes, _READING]),
    ):
        if items:
            lines += ["", f"## {title}", "", *(f"- {_cell(item)}" for item in items)]
    if measured.encoders:
        rows = [
            [a.name, kind, a.source, a.weights_sha256, a.preprocessing]
            for kind, a in sorted(measured.encoders.items())
        ]
        lines += [
            "",
            "## Encoders",
            "",
            *_grid(["name", "kind", "source", "SHA-256 of the weights", "pictures"], rows),
        ]
    shown = [row for row in measured.rows if row.key != "edit.psnr_pooled"]
    if shown:
        names = sorted({name for row in shown for name in row.views}, key=natural)
        rows = [
            [name, *(_value(row, row.views[name]) if name in row.views else "" for row in shown)]
            for name in names
        ]
        heads = [row.title.removesuffix(", mean of the views") for row in shown]
        lines += ["", "## View by view", "", *_grid(["view", *heads], rows)]
    return "\n".join(lines) + "\n"


def table(measured: Measured) -> Table:
    """The figures, for a terminal; encoders by their kind, since the names of real ones are
    long."""
    from rich.table import Table
    from rich.text import Text

    grid = Table(
        "figure", "value", "views", "undefined", "better", title="Metrics of the edited scene"
    )
    for cells in _overview(measured):
        grid.add_row(*map(Text, cells[:5]))
    return grid


def write(measured: Measured, folder: Path) -> list[Path]:
    """Write metrics.json and metrics.md, over older ones."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, text in (("metrics.json", to_json(measured)), ("metrics.md", to_markdown(measured))):
        write_atomic(folder / name, text.encode())
        paths.append(folder / name)
    return paths


def _overview(measured: Measured) -> list[list[str]]:
    rows = []
    for row in measured.rows:
        encoder = "" if row.encoder is None else measured.encoders[row.encoder].name
        defined = len(row.views) - len(row.undefined)
        rows.append(
            [
                row.title,
                _value(row, row.value),
                str(defined),
                str(len(row.undefined)),
                _spec(row).direction,
                encoder,
            ]
        )
    rows += [[title, "not computed", "0", "", "", ""] for title in measured.missing]
    return rows


def _spec(row: Row) -> Metric:
    return metric(row.key)


def _value(row: Row, value: float) -> str:
    """To the digits that the field's tables have: 3 after the point, 4 for a distance."""
    if math.isnan(value):
        return "identical" if row.identical and not row.undefined else "undefined"
    if math.isinf(value):
        return "inf (identical)"
    if row.encoder == "perceptual":
        return f"{value:.4f}"
    return f"{value:.3f} dB" if _spec(row).unit == "dB" else f"{value:.3f}"


def _number(value: float) -> Any:
    """As JSON: NaN is null, and an infinite PSNR, of equal pictures, is "inf"."""
    return "inf" if math.isinf(value) else without_nan(value)


def _grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [heads, ["---"] * len(heads), *rows]
    return ["| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines]


def _cell(text: str) -> str:
    """Of one line, and without what Markdown would take for a table's or a tag's."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
