"""The table of all scenes: which effects each one needs, the plan, its proof, what it saves, and
what it looks like.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp_eval.cache import content_key
from attnwarp_eval.effects.detect import detect
from attnwarp_eval.effects.saving import measure
from attnwarp_eval.scene.materials import NOT_SIMULATED
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.transport import called_for
from attnwarp_eval.truth.plan import everything_on, plan

if TYPE_CHECKING:
    from attnwarp_eval.document.model import Table

PROTOCOL = 2
"""Raised whenever an entry would come out otherwise."""

USUAL = ("geometry", "direct", "shadows", "textures")
"""Effects that nearly every scene calls for, and that no plan leaves out."""

TIMED = (
    "time, everything on / plan",
    "at equal noise",
    "light changed by the cap",
    "time, everything on within the cap / plan",
    "at equal error",
)
"""Columns that come from timing."""

AMPLIFIED = 8.0
"""How much stronger the difference of two pictures is shown."""

PICTURE_SIZE, PLAN_SAMPLES, FULL_SAMPLES = 160, 64, 256
"""Of the pictures side by side. Enough samples that the difference shows more than noise."""


@dataclass(frozen=True)
class Settings:
    """How an entry is made.

    Attributes:
        prove: climb the ladder of :mod:`attnwarp_eval.effects.proof`.
        budget: seconds that a proof may render.
        rounds: of the timing against everything on; 0 for none.
        pictures: whether plan, everything on and their difference are drawn.
    """

    prove: bool = True
    budget: float = 60.0
    rounds: int = 7
    pictures: bool = True


def collect(
    names: Sequence[str],
    out: Path,
    settings: Settings,
    progress: Callable[[str, int], None] = lambda *_: None,
) -> list[dict[str, Any]]:
    """Make the table's entries and write them, with their pictures, below ``out``; what is there
    already is kept.

    Entries are kept by the scene's content, the settings and Mitsuba's version and variant: after
    an interruption, or when one scene has changed, only what is missing is made.

    Args:
        names: scenes' names or paths.
        out: folder of ``effects.json``, ``effects.md`` and ``<scene>.jpg``.
        progress: told what is at work and how many scenes are done.

    Returns:
        The entries, as they stand in ``effects.json``.

    Raises:
        InputError: a scene that is unknown or contradicts itself, or an ``effects.json`` of
            something else.
    """
    import mitsuba

    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth.llvm import variant
    from attnwarp_eval.truth.mitsuba import APPEARANCE_PROTOCOL, forget

    known = _read(out / "effects.json")
    entries = []
    for number, name in enumerate(names):
        scene = load_scene(name)
        key = content_key(
            "effects",
            PROTOCOL,
            APPEARANCE_PROTOCOL,
            mitsuba.__version__,
            variant(),
            scene.content_hash,
            settings.prove,
            settings.budget,
            settings.rounds,
        )
        entry = known.get(scene.name)
        if (
            entry is None
            or entry["key"] != key
            or (settings.pictures and not (out / entry["picture"]).is_file())
        ):
            entry = {"key": key} | _entry(
                scene, out, settings, functools.partial(_told, progress, number)
            )
            known[scene.name] = entry
        entries.append(entry)
        # Scenes of an earlier call stay in the file; the table is of those asked for, as far as
        # they are done.
        _write(out, known, entries)
        forget()
    return entries


def _entry(
    scene: Scene, out: Path, settings: Settings, progress: Callable[[str], None]
) -> dict[str, Any]:
    from attnwarp_eval.effects.proof import prove
    from attnwarp_eval.truth.llvm import variant

    progress(f"{scene.name}: effects")
    found = detect(scene)
    planned = plan(scene)
    entry: dict[str, Any] = {
        "scene": scene.name,
        "title": scene.title,
        "content": scene.content_hash,
        "variant": variant(),
        "needed": [name for name in found if found[name].needed and found[name].simulated],
        "left_out": [name for name in found if found[name].source == "said"],
        "not_simulated": [
            name for name in found if found[name].needed and not found[name].simulated
        ],
        "plan": planned.to_dict(),
        "everything_on": everything_on(scene, capped=False).to_dict(),
        "picture": f"{scene.name}.jpg",
    }
    if settings.rounds:
        progress(f"{scene.name}: time against everything on")
        cost = measure(scene, rounds=settings.rounds)
        entry["cost"] = cost.to_dict()
    if settings.prove:
        progress(f"{scene.name}: proof")
        proof = prove(scene, seconds=settings.budget)
        entry["proof"] = proof.to_dict()
    if settings.pictures:
        progress(f"{scene.name}: pictures")
        out.mkdir(parents=True, exist_ok=True)
        entry |= side_by_side(scene, out / entry["picture"])
    return entry


def side_by_side(scene: Scene, path: Path) -> dict[str, Any]:
    """Write plan, everything on and their difference (grey is none, ``AMPLIFIED`` times) as one
    JPEG.

    Returns:
        "largest_difference": of an 8 x 8 block of the displayed pictures, in [0, 1].
    """
    import cv2

    from attnwarp_eval.colors import to_srgb
    from attnwarp_eval.effects.proof import blocks
    from attnwarp_eval.truth.mitsuba import comparable, render_plan

    small = scene.with_size(PICTURE_SIZE, PICTURE_SIZE)
    made_by = comparable(small)
    ours, full = (
        to_srgb(render_plan(small, small.source, made, 40 + k, made_by=made_by))
        for k, made in enumerate((plan(small, PLAN_SAMPLES), everything_on(small, FULL_SAMPLES)))
    )
    difference = ours.astype(np.float64) - full
    shown = np.clip(0.5 + AMPLIFIED / 2 * difference, 0, 1)
    gap = np.ones((PICTURE_SIZE, 4, 3))
    row = np.concatenate([ours, gap, full, gap, shown], axis=1)
    pixels = np.clip(np.rint(row * 255), 0, 255).astype(np.uint8)
    if not cv2.imwrite(str(path), pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88]):
        raise OSError(f"{path}: could not be written")
    largest: npt.NDArray[np.float64] = np.abs(blocks(difference[None]))
    return {"largest_difference": float(largest.max())}


def _read(path: Path) -> dict[str, dict[str, Any]]:
    from attnwarp.errors import InputError

    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    try:
        return {
            entry["scene"]: entry
            for entry in json.loads(text)["scenes"]
            if entry["key"] and entry["picture"]
        }
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: it is not a table of effects; name another folder with --out, or remove the"
            " file"
        ) from None


def _told(progress: Callable[[str, int], None], number: int, text: str) -> None:
    progress(text, number)


def _write(out: Path, known: Mapping[str, Any], shown: Sequence[Mapping[str, Any]]) -> None:
    from attnwarp_eval.cost import environment

    data: dict[str, Any] = {
        "environment": environment(),
        "scenes": [known[name] for name in sorted(known)],
    }
    _replace(out / "effects.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
    _replace(out / "effects.md", _page(shown, data["environment"]))


def _replace(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


# Words
# --------------------------------------------------------------------------------------------------


def table(entries: Iterable[Mapping[str, Any]]) -> Table:
    """The entries as a table: effects, plan, and what was proved and timed of them."""
    from attnwarp_eval.document.model import Table

    columns = [
        "scene",
        "beyond the usual",
        "not simulated",
        "plan",
        "proof",
        "bound",
        "smallest difference seen",
        *TIMED,
    ]
    rows = []
    for entry in entries:
        proof, cost = entry.get("proof"), entry.get("cost")
        rows.append(
            [
                entry["scene"],
                ", ".join(name for name in entry["needed"] if name not in USUAL) or "–",
                ", ".join(entry["not_simulated"]) or "–",
                plan_words(entry["plan"]),
                "not asked" if proof is None else proof_words(proof),
                _bound(proof),
                _smallest(proof),
                *_times(cost),
            ]
        )
    return Table(columns, rows, timed=TIMED)


def plan_words(planned: Mapping[str, Any]) -> str:
    """A plan in a few words: integrator, and the camera where it is not a pinhole."""
    return str(planned["integrator"]) + (
        ", thin lens" if planned["sensor"]["type"] == "thinlens" else ""
    )


def proof_words(proof: Mapping[str, Any]) -> str:
    """A verdict in a few words, with what the comparison alone came to where something is not
    simulated.
    """
    if proof["verdict"] == proof["of_simulated"]:
        return str(proof["verdict"])
    return f"{proof['verdict']} ({proof['of_simulated']} but for what is not simulated)"


def _bound(proof: Mapping[str, Any] | None) -> str:
    if proof is None:
        return "–"
    if "any" in proof["detectable"]:
        return "same bits"
    found = [rung["numbers"] for rung in proof["rungs"] if rung["name"] == "equivalence"]
    return f"{abs(found[0]['difference']) + 2.33 * found[0]['error']:.2%}" if found else "–"


def _smallest(proof: Mapping[str, Any] | None) -> str:
    if proof is None or "any" in proof["detectable"]:
        return "–"
    return ", ".join(
        f"{name} {proof['detectable'][name]:.2g}"
        for name in ("picture", "block", "pixel")
        if name in proof["detectable"]
    )


def _times(cost: Mapping[str, Any] | None) -> list[str]:
    from attnwarp_eval.document.numbers import number

    if cost is None:
        return ["–"] * len(TIMED)

    def ratio(equal: float | None, interval: Sequence[float] | None) -> str:
        between = f" [{number(interval[0])}, {number(interval[1])}]" if interval else ""
        return "the plan has no noise" if equal is None else number(equal) + between

    noise, cap = ratio(cost["at_equal_noise"], cost["interval"]), cost["cap"]
    if cap is None:
        # Both pictures have the same mean, so that equal noise is equal error.
        return [number(cost["faster"]), noise, "no cap", number(cost["faster"]), noise]
    bias = "–"
    if cap["bias"] is not None:
        bias = (
            f"{cap['bias']:+.1%} [{cap['bias_interval'][0]:+.1%}, {cap['bias_interval'][1]:+.1%}]"
        )
    return [
        number(cost["faster"]),
        noise,
        bias,
        number(cap["faster"]),
        ratio(cap["at_equal_error"], cap["interval"]),
    ]


def _page(entries: Sequence[Mapping[str, Any]], about: Mapping[str, Any]) -> str:
    from attnwarp_eval.document.model import Gallery, Picture, Report, Section
    from attnwarp_eval.document.write import markdown

    certified = sum(entry.get("proof", {}).get("verdict") == "certified" for entry in entries)
    partly = (
        sum(entry.get("proof", {}).get("of_simulated") == "certified" for entry in entries)
        - certified
    )
    variants = ", ".join(sorted({f"`{entry['variant']}`" for entry in entries}))
    costs = [entry["cost"] for entry in entries if "cost" in entry]
    lead = [
        f"{len(entries)} scenes, {certified} of their plans certified"
        + (f", {partly} more but for what is not simulated" if partly else "")
        + f". Mitsuba {about['versions']['mitsuba']} as "
        f"{variants}. Made by `attnwarp-eval scenes effects --all --prove --out <this folder>`.",
        (
            f"**Beyond the usual**: effects besides {', '.join(USUAL)}. **Proof**: the ladder of"
            " docs/effects.md at 32 x 32 from the source; **bound** is |d| + 2.33 SE of the"
            " picture's mean, which must stay below 1 %; the **smallest difference** that would"
            " have been seen with 80 % chance is a share of the picture's mean, for the picture,"
            " an 8 x 8 block and a pixel."
        ),
    ]
    if costs:
        lead.append(
            f"**Times**: {costs[0]['size']} x {costs[0]['size']}, {costs[0]['spp']} samples, in"
            f" turn, {costs[0]['rounds']} rounds. Everything on follows light until roulette ends"
            " it. **At equal noise**: the same times the ratio of variances. Where a scene caps"
            " its bounces the plan leaves light out by the scene's own word, so that the two"
            " pictures have other means and equal noise is not equal error: the **light changed by"
            " the cap** is the mean of the plan's pictures against that of everything on without a"
            " cap. **At equal error** is therefore against everything on within the cap, whose"
            " pictures have the plan's mean. Intervals are 95 %, by bootstrap over rounds (of the"
            " light by Welch's test); above 1 the plan saves. An interval that holds 1 says that"
            " nothing was seen to be saved."
        )
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
    return markdown(
        Report("What light does in each scene, and what of it is simulated", lead, sections)
    )


def said_by(scene: Scene) -> dict[str, Any]:
    """What a run keeps of a scene's effects: those its file calls for, with the words, and the
    plan.
    """
    words = called_for(scene.spec)
    return {
        "needed": {name: text for name, text in words.items() if name not in NOT_SIMULATED},
        "not_simulated": {name: text for name, text in words.items() if name in NOT_SIMULATED},
        "plan": plan(scene).to_dict(),
        "everything_on": everything_on(scene, capped=False).integrator,
    }
