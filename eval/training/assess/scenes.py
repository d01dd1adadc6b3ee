"""Figures of an editor on the package's own scenes and sentences, which no recipe sees.

For each edit and view: of the true results of all the scene's edits, the one nearest to the editor's picture has to be
the one that was asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from training.assess.figures import Figure, figure
from training.assess.judge import Answer, nearest

SCENES = ("bear", "person", "dinosaur", "face", "garden", "stump")
"""The scenes that have edits, as the paper's."""

VIEWS = 3
SAMPLES = 64
"""Light paths a pixel of the true pictures."""

LEAST_PIXELS = 12
"""Pixels that an edited object must have in a view to be judged there."""


@dataclass
class SceneAnswers:
    """Marks of answers, right or not, and their scenes.

    Attributes:
        asked: of the sentence that was given.
        wrong: of the same pictures, edited by the sentence of the scene's next edit, still judged by the first.
        unedited: of the view as it is.
        scenes: the scene of each.
        chance: share of the scene's results that are right.
    """

    asked: list[bool] = field(default_factory=list)
    wrong: list[bool] = field(default_factory=list)
    unedited: list[bool] = field(default_factory=list)
    scenes: list[str] = field(default_factory=list)
    chance: list[float] = field(default_factory=list)


def scene_answers(answer: Answer, *, size: int, scenes: Sequence[str] = SCENES) -> SceneAnswers:
    """Edit views of each scene by each of its sentences, and judge the pictures."""
    from attnwarp_eval.study.edit_truth import edit_truth
    from attnwarp_eval.world import world

    result = SceneAnswers()
    for name in scenes:
        targets = list(world(name, size).targets)
        chosen = [targets[k] for k in np.linspace(0, len(targets) - 1, VIEWS).round().astype(int)]
        edits = {e.name: e.instruction for e in world(name, size).scene.spec.edits}
        truths = {e: edit_truth(name, size, SAMPLES, e, tuple(chosen)) for e in edits}
        for k, (edit, sentence) in enumerate(edits.items()):
            other = list(edits.values())[(k + 1) % len(edits)]
            for view in chosen:
                mask = truths[edit].union[view]
                if mask.sum() < LEAST_PIXELS:
                    continue
                results = [
                    (owner, pictures[view])
                    for owner, truth in truths.items()
                    for pictures in truth.answers.values()
                ]
                owners, images = zip(*results, strict=True)
                before = truths[edit].originals[view]
                judged = (answer(before, sentence, k), answer(before, other, k), before)
                asked, wrong, unedited = (owners[nearest(i, images, mask)] == edit for i in judged)
                result.asked.append(asked)
                result.wrong.append(wrong)
                result.unedited.append(unedited)
                result.scenes.append(name)
                result.chance.append(owners.count(edit) / len(owners))
    return result


def scene_figures(answer: Answer, *, size: int) -> list[Figure]:
    """Three figures: the sentence that was asked for, another one, and no edit."""
    a = scene_answers(answer, size=size)
    chance = float(np.mean(a.chance))
    return [
        figure("nearest of a scene's true results is the one asked for", a.asked, a.scenes, chance=chance, asked=0.7),
        figure("... by the sentence of another edit (control)", a.wrong, a.scenes, chance=chance),
        figure("... of the view as it is (control)", a.unedited, a.scenes, chance=chance),
    ]  # fmt: skip
