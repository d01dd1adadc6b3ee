"""Agreement of an edit's views: disagreement above its floor, one answer everywhere, fidelity to
the nearest truth, each by yaw.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from attnwarp_eval.metrics._pictures import picture, region
from attnwarp_eval.metrics.arrays import mean, share
from attnwarp_eval.metrics.consistency import cross_view
from attnwarp_eval.metrics.fidelity import fidelity, nearest_answer
from attnwarp_eval.metrics.image import Distance, mse

if TYPE_CHECKING:
    from attnwarp_eval.two_view import TwoView

YAW_EDGES = (0, 15, 30, 60, 90, 120, 150, 180)
"""Ends of the bins in degrees, those of :func:`attnwarp_eval.metrics.by_yaw`."""


ABOVE_FLOOR = "multiview.delta_e_above"
"""Beginning of the names of disagreement above its floor."""

BELOW_FLOOR = (
    "Disagreement is **below its floor**, so negative, where edited views are more alike than the"
    " true edited views. Something that differs between true views, such as shine, a shadow's edge"
    " or fine texture, is lost there. Less is no gain there."
)
"""Meaning of a negative disagreement above the floor, in words for a report."""


def above_floor(
    edited: tuple[Any, Any],
    truth: tuple[Any, Any],
    pair: TwoView,
    *,
    mask: Any = None,
    exclude: Any = None,
) -> dict[str, float]:
    """Disagreement of two edited views about the same surface points, and that of the true edited
    views at the same pixels.

    Args:
        edited: (H, W, 3) sRGB in [0, 1] of source and target after the edit.
        truth: the same two views of the truly edited scene. For an ambiguous edit: of the answer
            that :func:`attnwarp_eval.metrics.nearest_answer` names.
        pair: :func:`attnwarp_eval.truth.two_view` of source and target.
        mask, exclude: as for :func:`attnwarp_eval.metrics.cross_view`.

    Returns:
        ``multiview.delta_e`` (mean CIEDE2000), ``multiview.delta_e_floor`` (of the truth),
        ``multiview.delta_e_above`` (their difference, which may be negative),
        ``multiview.pixels`` and ``multiview.share`` of the pixels asked about. NaN where no pixel
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
    difference = cross_view(*edited, pair, mask=mask, exclude=exclude)
    floor = cross_view(*truth, pair, mask=mask, exclude=exclude)
    # The pixels follow from the geometry alone, so both are means over the same ones.
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
    """The right answer of an ambiguous edit that each view by itself is nearest to, by MSE.

    Args:
        images: (H, W, 3) sRGB in [0, 1] by the view's name, the edited views.
        answers: by the answer's name, its truth in the same views.
        masks: (H, W) bool by the view's name, the edited object.

    Returns:
        By the view's name, the answer's name; None where the view shows nothing of the object. Of
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


def same_answer(nearest: Mapping[str, str | None], source: str) -> dict[str, float]:
    """The share of the views whose nearest answer is the source's.

    Args:
        nearest: from :func:`answers_by_view`.
        source: the source view's name.

    Returns:
        ``multiview.same_answer`` over the other views that have an answer, their number
        ``multiview.views``, and ``multiview.views_undefined``, which have none. NaN where the
        source or every other view has none.

    Raises:
        ValueError: the source is not among the views.

    Example:
        >>> from attnwarp_eval import metrics
        >>> nearest = {"source": "red", "a": "red", "b": "blue", "c": None}
        >>> figures = metrics.same_answer(nearest, "source")
        >>> figures["multiview.same_answer"], figures["multiview.views_undefined"]
        (0.5, 1)
    """
    if source not in nearest:
        raise ValueError(f"source: got {source!r}, expected one of {', '.join(nearest)}")
    own = nearest[source]
    others = [answer for view, answer in nearest.items() if view != source]
    defined = [answer for answer in others if answer is not None]
    equal = sum(answer == own for answer in defined)
    return {
        "multiview.same_answer": share(equal, len(defined)) if own is not None else math.nan,
        "multiview.views": len(defined),
        "multiview.views_undefined": len(others) - len(defined),
    }


def edit_fidelity(
    images: Mapping[str, Any],
    answers: Mapping[str, Mapping[str, Any]],
    masks: Mapping[str, Mapping[str, Any]],
    *,
    originals: Mapping[str, Any] | None = None,
    distance: Distance | None = None,
) -> tuple[str | None, dict[str, dict[str, float]]]:
    """Fidelity of each view to the answer that all views together are nearest to.

    One answer for all views: a view that shows another right answer is wrong there.

    Args:
        images: (H, W, 3) sRGB in [0, 1] by the view's name, the edited views.
        answers: by the answer's name, its truth in the same views; an edit with one result has one.
        masks: by the answer's name and the view's, (H, W) bool, the edited object. The nearest
            answer is decided inside the union of a view's masks, so that every answer is held
            against the same pixels.
        originals: the views before the edit.
        distance: a perceptual distance.

    Returns:
        The answer's name, None where nothing could be measured; and the figures of
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


@dataclass(frozen=True)
class YawMean:
    """Views whose yaw lies in [low, high), the last bin with its upper end.

    Attributes:
        low, high: degrees.
        views: those with a value.
        undefined: those without.
        mean: of the values, each view counting alike; NaN without any.

    Example:
        >>> from attnwarp_eval.metrics import YawMean
        >>> YawMean(0, 90, views=2, undefined=0, mean=0.5).mean
        0.5
    """

    low: float
    high: float
    views: int
    undefined: int
    mean: float


def mean_by_yaw(
    values: Mapping[str, float], yaw: Mapping[str, float], edges: Sequence[float] = YAW_EDGES
) -> list[YawMean]:
    """Means of a figure over the views of each bin of yaw.

    Args:
        values: by the view's name; NaN where undefined.
        yaw: by the view's name, degrees from the source, of either sign.
        edges: ends of the bins, rising from 0 to 180.

    Returns:
        One entry for each bin, empty ones included.

    Raises:
        ValueError: edges that do not rise from 0 to 180, or a view without a yaw.

    Example:
        >>> from attnwarp_eval import metrics
        >>> values, yaw = {"a": 1.0, "b": 3.0}, {"a": -10, "b": 350}
        >>> metrics.mean_by_yaw(values, yaw, edges=(0, 90, 180))[0].mean
        2.0
    """
    ends = [float(edge) for edge in edges]
    rising = all(a < b for a, b in itertools.pairwise(ends))
    if len(ends) < 2 or ends[0] != 0 or ends[-1] != 180 or not rising:
        raise ValueError(f"edges: got {list(edges)}, expected rising degrees from 0 to 180")
    bins: list[list[float]] = [[] for _ in ends[1:]]
    for view, value in values.items():
        if view not in yaw:
            raise ValueError(f"yaw: lacks the view {view!r} of values")
        folded = abs((float(yaw[view]) + 180) % 360 - 180)
        index = min(int(np.searchsorted(ends, folded, side="right")) - 1, len(bins) - 1)
        bins[index].append(float(value))
    result = []
    for low, high, entries in zip(ends, ends[1:], bins, strict=False):
        defined = np.array([value for value in entries if not math.isnan(value)])
        missing = len(entries) - len(defined)
        result.append(YawMean(low, high, len(defined), missing, mean(defined)))
    return result
