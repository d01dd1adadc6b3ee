"""The ideal editor on a bench: its answers are an edit's right answers, its thing has one part."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_lab.ideal.editor import FACTOR, Answers, IdealEditor
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.share import Grams, solve_share

SETTLED = 0.4
"""Share of the steps after which views alone have settled, as in the study `ideal`."""


def bench_editor(
    images: Mapping[str, npt.NDArray[np.float32]], truth: EditTruth, steps: int
) -> IdealEditor:
    """The ideal editor of a bench's edit.

    Args:
        images: (H, W, 3) sRGB in [0, 1] before the edit, by view.
        truth: truth of the edit.
        steps: number of steps of denoising.
    """
    views = []
    for name, image in images.items():
        H, W = image.shape[:2]
        labels = np.where(truth.union[name], 0, -1).astype(np.int16)
        after = np.stack([pictures[name] for pictures in truth.answers.values()])
        views.append(Answers(image, after, token_parts(labels, (H // FACTOR, W // FACTOR))))
    # One answer is known from the beginning.
    share = solve_share(Grams.of(views), SETTLED, steps) if truth.ambiguous else 1.0
    return IdealEditor(views, share)
