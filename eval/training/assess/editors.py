"""Figures of a bundled editor on worlds that it has never seen, each figure with its interval,
beside an editor that changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attnwarp.editing.editor import Image, edit
from attnwarp_eval.drawn.worlds import COLORS
from training.assess.card_sections import asked_for, percent, short_of
from training.assess.figures import Figure, figure
from training.assess.judge import Answer, nearest, outside_psnr
from training.assess.pictures import Pictures, Row
from training.worlds.editing_pairs import (
    AMBIGUOUS,
    GROUPS,
    Worlds,
    ambiguous_instruction,
    instruction,
    load_pairs,
)

SEED = 77

ASSESSED = ("color", "material", "ground", "time")
LARGE_WORLDS = 20
"""Worlds that pictures of twice the size are judged on: they take four times as long."""


def answers_of(editor: Any, steps: int = 20) -> Answer:
    """An editor as a function."""
    return lambda image, text, seed: edit(editor, [image], text, seed=seed, steps=steps).images[0]


def unedited(image: Image, text: str, seed: int) -> Image:
    """The control that changes nothing."""
    return image


def assess(
    answer: Answer, worlds: Worlds, *, size: int, noises: int = 12, kinds: Sequence[str] = ASSESSED
) -> list[Figure]:
    """Held-out figures of an editor.

    For each world and kind of edit one pair of looks: of the world's true pictures of that kind, the one
    whose mean colour in the mask is nearest to the result's has to be the one that was asked for.

    Args:
        noises: number of noises of an open instruction, for each of a quarter of the worlds; 0 leaves that
            figure out.
    """
    pairs = Pictures(worlds, size)
    results = []
    outside: list[float] = []
    for kind in kinds:
        right, groups = [], []
        for world in range(len(worlds)):
            rng = np.random.default_rng([SEED, world, list(GROUPS).index(kind)])
            row = draw_row(pairs, world, kind, rng)
            before = pairs.shown(row, row.source)
            thing = pairs.mask(row)
            mask = thing if kind in ("color", "material") else ~thing
            text = instruction(
                kind, int(worlds.things[world]), worlds.looks[world, row.target], rng
            )
            image = answer(before, text, world)
            choices = [k for k in GROUPS[kind] if worlds.valid[world, k]]
            true = [pairs.shown(row, k) for k in choices]
            right.append(choices[nearest(image, true, mask)] == row.target)
            groups.append(world)
            if kind == "color":
                outside.append(outside_psnr(image, before, thing))
        count = len(GROUPS[kind])
        asked = 0.9 if kind == "color" else 0.85
        results.append(
            figure(
                f"nearest true {kind} is the one asked for",
                right,
                groups,
                chance=1 / count,
                asked=asked,
            )
        )
    results.append(
        figure(
            "at least 26 dB to the picture before, outside the thing",
            np.array(outside) >= 26,
            np.arange(len(outside)),
            asked=1.0,
        )
    )
    if noises:
        results.append(_open(answer, pairs, noises))
    return results


def _open(answer: Answer, pairs: Pictures, noises: int) -> Figure:
    """Share of cases in which an open instruction's result is nearer to one of the true answers
    than to the picture before.
    """
    worlds = pairs.worlds
    right, groups = [], []
    for world in range(0, len(worlds), 4):
        rng = np.random.default_rng([SEED, world, 99])
        row = draw_row(pairs, world, "color", rng)
        before, mask = pairs.shown(row, row.source), pairs.mask(row)
        text = ambiguous_instruction("color", int(worlds.things[world]), rng)
        choices = [k for k in GROUPS["color"] if k != row.source and worlds.valid[world, k]]
        true = [pairs.shown(row, k) for k in choices]
        for seed in range(noises):
            right.append(nearest(answer(before, text, seed), [before, *true], mask) > 0)
            groups.append(world)
    return figure(
        f"another colour, over {len(COLORS)}: an answer rather than the picture before",
        right,
        groups,
        asked=0.8,
    )


def draw_row(pairs: Pictures, world: int, kind: str, rng: np.random.Generator) -> Row:
    """A pair of looks of a world; half of the pictures are cut about the thing, as in training."""
    worlds = pairs.worlds
    assert kind in AMBIGUOUS
    valid = worlds.valid[world]
    view = int(rng.integers(worlds.ids.shape[1]))
    while True:
        source = int(rng.choice(worlds.sources(world, kind)))
        target = int(rng.choice([k for k in GROUPS[kind] if valid[k]]))
        row = Row(world, view, source, target, pairs.corner(world, view, rng))
        if (
            not np.array_equal(worlds.looks[world, source], worlds.looks[world, target])
            and pairs.mask(row).sum() >= 12
        ):
            return row


def editor_card(
    name: str, figures: Sequence[Figure], control: Sequence[Figure], facts: dict[str, Any]
) -> str:
    """A bundled editor's card in Markdown."""
    learned, missing = "", "parts of things (a jacket, a pot), "
    if facts["parts"]:
        learned, missing = (
            ", and on the parts of those of `attnwarp_eval/drawn/assemblies.py` (a jacket, a pot)",
            "",
        )
    earlier = f" after {facts['before']:,} of the stages before" if facts["before"] else ""
    larger = f" and of {facts['large']} x {facts['large']} px" if facts["large"] else ""
    lines = [
        f"# {name}", "",
        f"A picture and an instruction give the edited picture: a small InstructPix2Pix in diffusers' format. UNet of {facts['unet']:.1f} million"
        f" parameters, text encoder of {facts['text']:.2f} million, latents by a fixed orthogonal transform of 4 x 4 px"
        f" blocks. Trained on pictures of {facts['size']} x {facts['size']} px{larger}.", "",
        f"**State**: {facts['steps']:,} of {facts['planned']:,} planned steps of {facts['batch']} pictures{earlier}, {facts['minutes']:.0f} minutes in all on"
        f" {facts['device']}. {facts['state']}",
        "", "**Knows**: 11 colours, 6 materials, stripes and checks, 7 grounds, 4 times of day, on the things of"
        f" `attnwarp_eval/drawn/worlds.py`{learned}. **Does not know**: {missing}other words, photographs of the world.", "",
        f"**Data**: {facts['worlds'] + facts['parts']} random worlds by ray casting, two views and up to 30 looks each"
        " (`training/worlds/editing_pairs.py`); no scene of the package, none of its instructions. **Recipe**: `training/editors/recipe.py`.", "",
        "## Figures on what it has never seen", "",
        f"{facts['tested']} worlds with new shapes and all colours, 20 steps, text guidance {facts['text_guidance']:g}, image guidance {facts['image_guidance']:g}."
        " 95 % intervals are bootstrapped over worlds.", "",
        "| question | editor | unedited picture | chance | asked for | answers |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for own, other in zip(figures, control, strict=True):
        chance = "" if own.chance is None else f"{100 * own.chance:.0f} %"
        lines.append(
            f"| {own.what} | {percent(own)} | {100 * other.value:.0f} % | {chance} | {asked_for(own)} | {own.count} |"
        )
    lines += short_of(figures)
    return "\n".join([*lines, ""])


def assess_editor(
    folder: Path, data: Path, facts: dict[str, Any], *, worlds: int | None = None
) -> str:
    """The card of an exported editor."""
    from attnwarp.editing.small import IMAGE_GUIDANCE, TEXT_GUIDANCE, load_editor

    torch.set_num_threads(1)
    editor = load_editor(str(folder), text_guidance=TEXT_GUIDANCE, image_guidance=IMAGE_GUIDANCE)
    size = editor.own_size
    own: list[Figure] = []
    control: list[Figure] = []

    def ask(label: str, tests: Worlds, size: int, **how: Any) -> None:
        for results, answer in ((own, answers_of(editor)), (control, unedited)):
            figures = assess(answer, tests, size=size, **how)
            results += [replace(f, what=label + f.what) for f in figures]

    tested = 0
    splits = {"edit-test": "", "parts-test": "of a part: "}
    for name, label in splits.items() if facts["parts"] else [("edit-test", "")]:
        tests = load_pairs(data, name, count=worlds)
        tested += len(tests)
        ask(label, tests, size)
    if large := facts["large"]:
        tests = load_pairs(data, "edit-test", count=LARGE_WORLDS)
        ask(f"at {large} px: ", tests, large, kinds=("color",), noises=0)

    def millions(net: Any) -> float:
        return float(sum(p.numel() for p in net.parameters()) / 1e6)

    given = {
        "unet": millions(editor.network), "text": millions(editor.parts["text_encoder"]), "size": size, "tested": tested,
        "text_guidance": TEXT_GUIDANCE, "image_guidance": IMAGE_GUIDANCE,
    }  # fmt: skip
    return editor_card(folder.name, own, control, {**given, **facts})
