"""Figures of ``small-depth`` on depth maps and prompts that it has never seen, beside a wrong
prompt and another depth map.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.editing.editor import Image, edit
from training.assess.editors import SEED
from training.assess.figures import Figure, figure
from training.assess.judge import nearest
from training.assess.pictures import Row
from training.editors.depth import Prompts, attributes_of
from training.editors.net import TOKENS
from training.worlds.editing_pairs import GROUPS, load_pairs
from training.worlds.words import sentence

STEPS = 20

SHAPES = 10
"""Masks among which a picture has to show its own."""


def separation(image: Image, mask: npt.NDArray[np.bool_]) -> float:
    """Share of a picture's variance that a mask's two sides explain, as in Otsu's method (1979).

    Args:
        image: (H, W, 3).
        mask: (H, W).

    Returns:
        0 to 1; 0 where one side is empty.
    """
    total = np.square(image - image.mean(axis=(0, 1))).mean() * image.shape[2]
    share = mask.mean()
    if not 0 < share < 1 or total <= 0:
        return 0.0
    between = np.square(image[mask].mean(axis=0) - image[~mask].mean(axis=0)).sum()
    return float(share * (1 - share) * between / total)


def assess_depth(editor: Any, prompts: Prompts) -> list[tuple[Figure, Figure]]:
    """Held-out figures, each with the one of the control beside it.

    Returns:
        For each question the figure with the right prompt and depth map, and the control's: the same
        pictures asked about the next world's prompt, or shape.
    """
    worlds, count = prompts.worlds, len(prompts.worlds)
    results = []
    pictures: list[Image] = []
    masks = []
    for kind in ("color", "material", "ground", "time"):
        right, wrong = [], []
        for world in range(count):
            rng = np.random.default_rng([SEED, world, list(GROUPS).index(kind), 5])
            choices = [k for k in GROUPS[kind] if worlds.valid[world, k]]
            target = int(rng.choice(choices))
            corner = prompts.corner(world, 0, rng)
            row = Row(world, 0, target, target, corner)
            thing = prompts.mask(row)
            mask = thing if kind in ("color", "material") else ~thing
            if mask.sum() < 12:
                continue
            text = prompt_of(editor, prompts, row, rng)
            image = draw(editor, prompts, row, text, seed=world)
            true = [prompts.shown(row, k) for k in choices]
            answer = choices[nearest(image, true, mask)]
            right.append(answer == target)
            others = [k for k in choices if k != target]
            wrong.append(answer == others[int(rng.integers(len(others)))])
            if kind == "color":
                pictures.append(image)
                masks.append(thing)
        ids = np.arange(len(right))
        what = f"nearest true {kind} is the prompt's"
        results.append(
            (figure(what, right, ids, chance=1 / len(GROUPS[kind])), figure(what, wrong, ids))
        )
    right, wrong = [], []
    for index, image in enumerate(pictures):
        rng = np.random.default_rng([SEED, index, 98])
        strange = rng.permutation([k for k in range(len(masks)) if k != index])
        among = [index, *strange[: SHAPES - 1].tolist()]
        best = among[int(np.argmax([separation(image, masks[k]) for k in among]))]
        right.append(best == index)
        wrong.append(best == among[1])
    ids = np.arange(len(right))
    what = f"of {SHAPES} masks, the depth map's own parts the picture best"
    results.append((figure(what, right, ids, chance=1 / SHAPES), figure(what, wrong, ids)))
    return results


def draw(editor: Any, prompts: Prompts, row: Row, prompt: str, *, seed: int) -> Image:
    """A picture by the depth map of a row."""
    return edit(editor, [prompts.depth(row)], prompt, steps=STEPS, seed=seed).images[0]


def prompt_of(editor: Any, prompts: Prompts, row: Row, rng: np.random.Generator) -> str:
    """Everything that a look shows, in as many words as the editor takes."""
    thing, finish, color, second, ground, time = (
        int(v) for v in attributes_of(prompts.worlds, row.world)[row.target]
    )
    while True:
        text = sentence((thing, finish or -1, color, second, ground, time), rng)
        if len(editor.tokenizer(text).input_ids) <= TOKENS:
            return text


def assess_depth_editor(
    folder: Path, data: Path, facts: dict[str, Any], *, worlds: int | None = None
) -> str:
    """The card of an exported editor of depth maps."""
    from attnwarp.editing.small import DEPTH_GUIDANCE, load_editor

    torch.set_num_threads(1)
    editor = load_editor(str(folder), text_guidance=DEPTH_GUIDANCE)
    size = editor.own_size
    tests = load_pairs(data, "edit-test", count=worlds)
    results = assess_depth(editor, Prompts(tests, size))
    return depth_card(folder.name, results, {**facts, "size": size, "guidance": DEPTH_GUIDANCE})


def depth_card(name: str, results: Sequence[tuple[Figure, Figure]], facts: dict[str, Any]) -> str:
    """A card in Markdown."""
    lines = [
        f"# {name}", "",
        "A depth map and a prompt give a picture: a small depth ControlNet with its own UNet, in diffusers' format."
        f" Latents by a fixed orthogonal transform of 4 x 4 px blocks. Trained on pictures of {facts['size']} x {facts['size']} px.", "",
        f"**State**: {facts['steps']} of {facts['planned']} planned steps of {facts['batch']} pictures, {facts['minutes']:.0f} minutes on {facts['device']},"
        f" from the weights of the stage {facts['start']}. {facts['state']}", "",
        "**Knows**: 11 colours, 6 materials, stripes and checks, 7 grounds, 4 times of day, on the things of `attnwarp_eval/drawn/worlds.py`."
        " **Does not know**: parts of things (a jacket, a pot), other words, photographs of the world.", "",
        f"**Data**: {facts['worlds']} random worlds by ray casting, two views and up to 30 looks each (`training/worlds/editing_pairs.py`);"
        " no scene of the package, none of its descriptions. **Recipe**: `training/editors/depth.py`.", "",
        "## Figures on what it has never seen", "",
        f"Worlds with new shapes and all colours, {STEPS} steps, guidance {facts['guidance']:g}. The control asks the same pictures about another"
        " prompt or shape. 95 % intervals are bootstrapped over worlds.", "",
        "| question | editor | control | chance | answers |", "|---|---|---|---|---|",
    ]  # fmt: skip
    for own, control in results:
        lines.append(
            f"| {own.what} | **{100 * own.value:.0f} %** ({100 * own.low:.0f} to {100 * own.high:.0f}) | {100 * control.value:.0f} %"
            f" | {100 * (own.chance or 0):.0f} % | {own.count} |"
        )
    return "\n".join([*lines, ""])
