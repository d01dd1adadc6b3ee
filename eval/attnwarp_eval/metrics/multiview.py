"""Agreement of an edit's views: disagreement above its floor, answers, fidelity."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from attnwarp_eval.colors import color_difference, to_linear, to_srgb
from attnwarp_eval.metrics._pictures import picture, region
from attnwarp_eval.metrics.arrays import mean, share
from attnwarp_eval.metrics.consistency import cross_view
from attnwarp_eval.metrics.fidelity import fidelity, nearest_answer
from attnwarp_eval.metrics.image import Distance, mse

if TYPE_CHECKING:
    from attnwarp_eval.two_view import TwoView

LEAST_PART = 16
"""Pixels of a part in a view, below which its mean colour is not compared."""

ANOTHER_COLOR = 10.0
"""CIEDE2000 from which two mean colours are two answers."""


def above_floor(
    edited: tuple[Any, Any], truth: tuple[Any, Any], pair: TwoView, *, mask: Any = None
) -> dict[str, float]:
    """Compare the colours of two edited views at the same surface points, and of the true edited
    views at the same pixels.

    Args:
        edited: (H, W, 3) sRGB in [0, 1] of source and target after the edit.
        truth: the same two views of the truly edited scene. For an ambiguous edit: the answer
            that :func:`attnwarp_eval.metrics.nearest_answer` names.
        pair: :func:`attnwarp_eval.truth.two_view` of source and target.
        mask: as for :func:`attnwarp_eval.metrics.cross_view`.

    Returns:
        ``multiview.delta_e`` (mean CIEDE2000), ``multiview.delta_e_floor`` (of the truth),
        ``multiview.delta_e_above`` (their difference, which may be negative),
        ``multiview.pixels`` and ``multiview.share`` of the pixels considered. NaN if no pixel
        is counted.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.truth import Geometry, two_view
        >>> scene = load_scene("spheres").with_size(32, 32)
        >>> pair = two_view(Geometry(scene), scene.source, scene.targets[0])
        >>> grey = np.full((32, 32, 3), 0.5)
        >>> figures = metrics.above_floor((grey, grey), (grey, grey), pair)
        >>> figures["multiview.delta_e"], figures["multiview.delta_e_above"]
        (0.0, 0.0)
    """
    difference, floor = (cross_view(*views, pair, mask=mask) for views in (edited, truth))
    # The pixels follow from the geometry alone, so both means are over the same pixels.
    value, least = mean(difference.delta_e[difference.counted]), mean(floor.delta_e[floor.counted])
    pixels = int(difference.counted.sum())
    return {
        "multiview.delta_e": value,
        "multiview.delta_e_floor": least,
        "multiview.delta_e_above": value - least,
        "multiview.share": share(pixels, difference.candidates),
        "multiview.pixels": pixels,
    }


def answers_by_view(
    images: Mapping[str, Any],
    answers: Mapping[str, Mapping[str, Any]],
    masks: Mapping[str, Any] | None = None,
) -> dict[str, str | None]:
    """Right answer of an ambiguous edit nearest to each view alone, by MSE.

    Args:
        images: (H, W, 3) sRGB in [0, 1] by the view's name, the edited views.
        answers: truth of each answer in the same views, by name.
        masks: (H, W) bool by the view's name, the edited object.

    Returns:
        Answer's name by the view's name; None if the view shows none of the object. Of
        equally near answers the first.

    Raises:
        ValueError: no answers, or one without a view of ``images``.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> black, grey, white = (np.full((4, 4, 3), value) for value in (0.0, 0.4, 1.0))
        >>> answers = {"dark": {"a": black, "b": black}, "bright": {"a": white, "b": white}}
        >>> metrics.answers_by_view({"a": grey, "b": white}, answers)
        {'a': 'dark', 'b': 'bright'}
    """
    if not answers:
        raise ValueError("answers: got none, expected the truth of at least one")
    result: dict[str, str | None] = {}
    for view, image in images.items():
        edited = picture(image, f"images[{view!r}]")
        inside = region(None if masks is None else masks[view], edited.shape)
        errors = {}
        for name, truth in answers.items():
            if view not in truth:
                raise ValueError(f"answers[{name!r}]: lacks the view {view!r} of images")
            errors[name] = mse(edited, truth[view], inside)
        defined = {name: error for name, error in errors.items() if not math.isnan(error)}
        result[view] = min(defined, key=defined.__getitem__) if defined else None
    return result


def same_parts(
    before: tuple[Any, Any], after: tuple[Any, Any], parts: Iterable[tuple[Any, Any]]
) -> float:
    """Share of a thing's parts that have the source's colour in another view.

    The source's mean colour of a part is expected there as bright as the part was before the edit.
    A part that the source's edit left as it was shows no answer, and is left out.

    Args:
        before, after: (H, W, 3) sRGB in [0, 1] of source and view.
        parts: by part, (H, W) bool in the source and in the view, where its colours are averaged.

    Returns:
        The share; NaN if there is no part of :data:`LEAST_PART` pixels in both views.

    Example:
        >>> import numpy as np
        >>> grey = np.full((8, 8, 3), 0.5)
        >>> blue, red = grey * [0, 0, 1], grey * [1, 0, 0]
        >>> left = np.arange(64).reshape(8, 8) % 8 < 4
        >>> view = np.where(left[..., None], blue, red)
        >>> same_parts((grey, grey), (blue, view), [(left, left), (~left, ~left)])
        0.5
    """

    def mean(image: Any, inside: Any) -> Any:
        return to_linear(np.asarray(image, np.float64)[inside]).mean(axis=0)

    def apart(a: Any, b: Any) -> bool:
        one, two, all_of = to_srgb(a)[None, None], to_srgb(b)[None, None], np.ones((1, 1), bool)
        return color_difference(one, two, all_of) >= ANOTHER_COLOR

    found = []
    for own, there in parts:
        if min(own.sum(), there.sum()) < LEAST_PART:
            continue
        source, painted, view = mean(before[0], own), mean(after[0], own), mean(before[1], there)
        if apart(source, painted):
            light = view.sum() / max(source.sum(), 1e-6)
            found.append(not apart(painted * light, mean(after[1], there)))
    return share(sum(found), len(found))


def edit_fidelity(
    images: Mapping[str, Any],
    answers: Mapping[str, Mapping[str, Any]],
    masks: Mapping[str, Mapping[str, Any]],
    *,
    originals: Mapping[str, Any] | None = None,
    distance: Distance | None = None,
) -> tuple[str | None, dict[str, dict[str, float]]]:
    """Measure each view's fidelity to the answer nearest to all views together.

    One answer for all views: a view with another right answer is wrong.

    Args:
        images: (H, W, 3) sRGB in [0, 1] by the view's name, the edited views.
        answers: truth of each answer in the same views, by name; an unambiguous edit has one.
        masks: (H, W) bool by the answer's name and the view's, the edited object. The nearest
            answer is decided inside the union of a view's masks, so that every answer is compared
            at the same pixels.
        originals: the views before the edit.

    Returns:
        The answer's name, None if nothing could be measured; and the figures of
        :func:`attnwarp_eval.metrics.fidelity` by the view's name, none without an answer.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> white, mask = np.ones((16, 16, 3)), np.ones((16, 16), bool)
        >>> name, figures = metrics.edit_fidelity(
        ...     {"a": white}, {"dark": {"a": 0 * white}, "bright": {"a": white}},
        ...     {"dark": {"a": mask}, "bright": {"a": mask}},
        ... )
        >>> name, figures["a"]["fidelity.psnr"]
        ('bright', inf)
    """
    union = {
        view: np.logical_or.reduce([np.asarray(masks[name][view]) for name in answers])
        for view in images
    }
    name, _ = nearest_answer(images, answers, union)
    if name is None:
        return None, {}
    return name, {
        view: fidelity(
            image,
            answers[name][view],
            masks[name][view],
            original_srgb=None if originals is None else originals[view],
            distance=distance,
        )
        for view, image in images.items()
    }
