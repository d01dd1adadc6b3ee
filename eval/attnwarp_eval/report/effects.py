"""Which effects the run's scenes call for, and how their true pictures were made."""

from __future__ import annotations

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.effects.table import USUAL, plan_words
from attnwarp_eval.report.results import Results


def effects(results: Results) -> list[Section]:
    """The section of the report; nothing for a run made before the cells said so."""
    rows = []
    for cell in results.cells:
        said = (cell["record"] or {}).get("effects") if cell["probe"] == "calibration" else None
        if said is None:
            continue
        planned = said["plan"]
        beyond = [
            f"{name} ({words})" for name, words in said["needed"].items() if name not in USUAL
        ]
        rows.append(
            [
                cell["scene"],
                ", ".join(name for name in said["needed"] if name in USUAL) or "–",
                "; ".join(beyond) or "–",
                ", ".join(said["not_simulated"]) or "–",
                plan_words(planned),
                said["everything_on"],
                "; ".join(planned["reasons"]),
            ]
        )
    if not rows:
        return []
    text = [
        (
            "Depth, visibility and correspondences are cast with rays, without any light. The true"
            " pictures are rendered as each scene's plan says: only what it calls for is simulated."
            " A run does not prove its plans; `attnwarp-eval scenes effects NAME --prove` holds one"
            " against a rendering with everything on, and reports/effects in the repository has"
            " that for every scene that ships."
        ),
    ]
    columns = [
        "scene",
        "effects",
        "and",
        "not simulated",
        "plan",
        "everything on would be",
        "because",
    ]
    return [
        Section(
            "What light does in these scenes, and what of it is simulated",
            text,
            [Table(columns, rows)],
        )
    ]
