"""Table of all scenes: needed effects, plan, proof, saving, and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.document.model import Gallery, Picture, Report, Section, Table
from attnwarp_eval.document.numbers import bracketed, number
from attnwarp_eval.effects.detect import detect
from attnwarp_eval.effects.saving import measure
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.truth.plan import everything_on, plan

USUAL = ("geometry", "direct", "shadows", "textures")
"""Effects that nearly every scene needs, and that no plan omits."""

TIMED = ("time, everything on within the cap / plan", "at equal error")
"""Columns that come from timing."""

AMPLIFIED = 8.0
"""Factor that amplifies the shown difference of two pictures."""

PICTURE_SIZE, PLAN_SAMPLES, FULL_SAMPLES = 160, 64, 256
"""Width and samples of the pictures side by side; enough for more than noise to show."""


@dataclass(frozen=True)
class Settings:
    """Settings of an entry.

    Attributes:
        prove: whether to climb the ladder of :mod:`attnwarp_eval.effects.proof`.
        budget: seconds of rendering per proof.
        rounds: number of rounds of the timing against everything on; 0 for none.
        pictures: whether plan, everything on and their difference are drawn.
    """

    prove: bool = True
    budget: float = 60.0
    rounds: int = 7
    pictures: bool = True


def measure_entry(scene: Scene, settings: Settings, report: Reporter = SILENT) -> dict[str, Any]:
    """Measure a scene's effects, the cost of its plan, and the proof, as JSON. The pictures are
    those of :func:`side_by_side`.
    """
    from attnwarp_eval.effects.proof import prove
    from attnwarp_eval.truth.llvm import variant

    findings = detect(scene)
    entry: dict[str, Any] = {
        "scene": scene.name,
        "title": scene.title,
        "content": scene.content_hash,
        "variant": variant(),
        "needed": [name for name, one in findings.items() if one.needed and one.simulated],
        "left_out": [name for name, one in findings.items() if one.source == "said"],
        "not_simulated": [
            name for name, one in findings.items() if one.needed and not one.simulated
        ],
        "plan": plan(scene).to_dict(),
        "everything_on": everything_on(scene, capped=False).to_dict(),
        "picture": f"{scene.name}.jpg",
    }
    if settings.rounds:
        report.step(0, 0, f"{scene.name}: time against everything on")
        entry["cost"] = measure(scene, rounds=settings.rounds).to_dict()
    if settings.prove:
        report.step(0, 0, f"{scene.name}: proof")
        entry["proof"] = prove(scene, seconds=settings.budget).to_dict()
    return entry


def side_by_side(scene: Scene, path: Path) -> dict[str, Any]:
    """Write plan, everything on and their difference (grey is none, ``AMPLIFIED`` times) as one
    JPEG.

    Returns:
        "largest_difference": largest, over 8 x 8 blocks, of the displayed pictures, in [0, 1].
    """
    from attnwarp_eval.colors import to_srgb
    from attnwarp_eval.effects.proof import blocks
    from attnwarp_eval.files import write_picture
    from attnwarp_eval.truth.mitsuba import comparable, render_plan

    small = scene.with_size(PICTURE_SIZE, PICTURE_SIZE)
    made_by = comparable(small)
    ours, full = (
        to_srgb(render_plan(small, small.source, made, 40 + k, made_by=made_by))
        for k, made in enumerate((plan(small, PLAN_SAMPLES), everything_on(small, FULL_SAMPLES)))
    )
    difference = ours.astype(np.float64) - full
    amplified = np.clip(0.5 + AMPLIFIED / 2 * difference, 0, 1)
    gap = np.ones((PICTURE_SIZE, 4, 3))
    row = np.concatenate([ours, gap, full, gap, amplified], axis=1)
    write_picture(path, row, quality=88, chroma="420")
    largest: npt.NDArray[np.float64] = np.abs(blocks(difference[None]))
    return {"largest_difference": float(largest.max())}


# Words
# --------------------------------------------------------------------------------------------------


def table(entries: Iterable[Mapping[str, Any]]) -> Table:
    """The entries as a table: effects, plan, proof and times."""
    columns = ["scene", "beyond the usual", "not simulated", "plan", "proof", *TIMED]
    rows = [
        [
            entry["scene"],
            ", ".join(name for name in entry["needed"] if name not in USUAL) or "–",
            ", ".join(entry["not_simulated"]) or "–",
            plan_words(entry["plan"]),
            proof_words(entry["proof"]) if "proof" in entry else "not asked",
            *_times(entry.get("cost")),
        ]
        for entry in entries
    ]
    return Table(columns, rows, timed=TIMED)


def plan_words(planned: Mapping[str, Any]) -> str:
    """A plan in a few words: integrator, and the camera unless it is a pinhole."""
    return str(planned["integrator"]) + (
        ", thin lens" if planned["sensor"]["type"] == "thinlens" else ""
    )


def proof_words(proof: Mapping[str, Any]) -> str:
    """A verdict in a few words, with the comparison's if an effect is not simulated."""
    if proof["verdict"] == proof["of_simulated"]:
        return str(proof["verdict"])
    return f"{proof['verdict']} ({proof['of_simulated']} but for what is not simulated)"


def _times(cost: Mapping[str, Any] | None) -> list[str]:
    """Ratios of seconds, and of seconds at equal error, of everything on within the cap and the
    plan; without a cap equal noise is equal error.
    """
    if cost is None:
        return ["–"] * len(TIMED)
    of = cost["cap"] or {**cost, "at_equal_error": cost["at_equal_noise"]}
    equal, bounds = of["at_equal_error"], of["interval"]
    if equal is None:
        return [number(of["faster"]), "the plan has no noise"]
    return [number(of["faster"]), bracketed(equal, *(bounds or ()))]


def report(entries: Sequence[Mapping[str, Any]], about: Mapping[str, Any]) -> Report:
    """The table, and the pictures side by side; ``about`` is the environment."""
    certified = sum(entry.get("proof", {}).get("verdict") == "certified" for entry in entries)
    variants = ", ".join(sorted({f"`{entry['variant']}`" for entry in entries}))
    lead = [
        f"{len(entries)} scenes, {certified} of their plans certified. Mitsuba"
        f" {about['versions']['mitsuba']} as {variants}. Made by `attnwarp-eval scenes effects"
        " --all --prove --out <this folder>`.",
        f"**Beyond the usual**: effects besides {', '.join(USUAL)}. **Proof**: the ladder of"
        " docs/truth/truth.md. **Times**: in turn, against everything on within the scene's cap on"
        " bounces, whose pictures have the plan's mean; intervals are 95 %, by bootstrap over"
        " rounds. Above 1 the plan saves.",
    ]
    sections = [Section("Every scene", tables=[replace(table(entries), timed=())])]
    drawn = [entry for entry in entries if "largest_difference" in entry]
    if drawn:
        text = [
            (
                f"The plan ({PLAN_SAMPLES} samples), everything on within the scene's own cap on"
                f" bounces ({FULL_SAMPLES}), and their difference as displayed, {AMPLIFIED:g} times"
                " (grey is none). What is left is noise, most of it everything on's. The number is"
                " the largest difference of an 8 x 8 block, of 1."
            ),
        ]
        rows = [
            (f"**{e['scene']}** ({plan_words(e['plan'])}; {e['largest_difference']:.4f})",
             [Picture(e["picture"], f"{e['scene']}: plan, everything on, difference")])
            for e in drawn
        ]  # fmt: skip
        sections.append(Section("Side by side", text, gallery=Gallery(rows)))
    return Report("What light does in each scene, and what of it is simulated", lead, sections)
