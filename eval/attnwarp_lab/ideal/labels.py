"""Label transport: part labels carried along the tokens of a warp, against exact truth.

No diffusion is needed: the label that a token takes depends only on the warp and its mask.
docs/measuring/ideal-editor.md describes what the figures can and cannot decide.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.warp import FeatureWarp
from attnwarp_eval.metrics.arrays import share

Labels = npt.NDArray[np.int16]
Mask = npt.NDArray[np.bool_]

NONE = -2
"""Label of a token without features."""

OUTSIDE = -1
"""Label of a token that does not show the thing."""


EDGE = 0.05
"""Relative depth step that counts as an edge."""

FEWEST = 20
"""Visible tokens below which a view has no net share: one token would move it by over 5 points."""


def carried_labels(layer: FeatureWarp, source: Labels) -> Labels:
    """(h, w) label that each token of a target takes: that of the heaviest tap.

    Args:
        source: (h', w') part of each token of the source, -1 outside the thing; or labels that it
            took itself.

    Returns:
        A part, :data:`OUTSIDE`, or :data:`NONE` where the mask is False or nothing is taken. Of
        equal weights the smallest label.

    Example:
        >>> import numpy as np, torch
        >>> from attnwarp import Camera
        >>> from attnwarp.warp import FeatureWarp, correspond
        >>> from attnwarp_lab.ideal.labels import carried_labels
        >>> camera = Camera(np.array([[2.0, 0, 1], [0, 2, 1], [0, 0, 1]]), np.eye(4), 2, 2)
        >>> same = correspond(camera, camera, np.ones((2, 2)))
        >>> layer = FeatureWarp(same, torch.tensor([[True, True], [True, False]]))
        >>> carried_labels(layer, np.array([[0, 1], [-1, 1]], np.int16)).tolist()
        [[0, 1], [-1, -2]]
    """
    check.shape(source, ("h", "w"), "source")
    codes = np.arange(min(OUTSIDE, int(source.min())), int(source.max()) + 1)
    one_hot = (source == codes[:, None, None]).astype(np.float32)
    weights = np.nan_to_num(np.asarray(layer.warp(one_hot)))
    labels = codes[weights.argmax(axis=0)]
    return np.where(np.asarray(layer.mask), labels, NONE).astype(np.int16)


def most(pixels: Mask, size: tuple[int, int]) -> Mask:
    """(h, w) bool: tokens of which more than half of the pixels are True.

    Args:
        pixels: (H, W), sides that are multiples of the grid's.
        size: (h, w) of the grid.
    """
    (H, W), (h, w) = pixels.shape, size
    cells = pixels.reshape(h, H // h, w, W // w).sum(axis=(1, 3))
    return np.asarray(2 * cells > (H // h) * (W // w))


def depth_edges(depth: npt.NDArray[Any]) -> Mask:
    """Mark the pixels on either side of a depth edge, (H, W) bool.

    Inverse depth is affine in the pixel on a plane, so an inverse-depth step larger than its
    neighbours' is an edge, and a plane at a grazing angle has none. Pixels of the outermost rows
    and columns have one neighbour and are marked from that side alone.

    Args:
        depth: (H, W); NaN without a surface, which counts as infinite.

    Example:
        >>> depth_edges(np.array([[2.0, 2.0, 2.0, 3.0, 3.0, 3.0]]))[0].astype(int).tolist()
        [0, 0, 1, 1, 0, 0]
    """
    inverse = np.nan_to_num(1 / depth, nan=0.0)
    edge = np.zeros(depth.shape, dtype=bool)
    for values, marks in ((inverse, edge), (inverse.T, edge.T)):
        left, middle, right = values[:-2], values[1:-1], values[2:]
        nearest = np.maximum(np.maximum(left, middle), right)
        marks[1:-1] |= np.abs(left - 2 * middle + right) > EDGE * nearest
    return edge


def edge_distance(depth: npt.NDArray[Any], size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """(h, w) distance of each token to the nearest depth edge, in tokens; infinite without one.

    A pixel of :func:`depth_edges` has distance 0; a token has the distance of its nearest pixel.

    Args:
        depth: (H, W) true depth of the target; NaN without a surface.
        size: (h, w) of the grid; divisors of H and W.

    Example:
        >>> import numpy as np
        >>> step = np.where(np.arange(16) < 4, 2.0, 4.0) * np.ones((4, 1))
        >>> edge_distance(step, (1, 4)).tolist()
        [[0.0, 0.0, 1.0, 2.0]]
    """
    (H, W), (h, w) = depth.shape, size
    away = (~depth_edges(depth)).astype(np.uint8)
    if away.all():
        return np.full(size, np.inf)
    px = cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    nearest = px.reshape(h, H // h, w, W // w).min(axis=(1, 3))
    return np.asarray(nearest / (H // h), dtype=np.float64)


def label_transport(
    carried: Labels,
    tokens: Labels,
    pixels: Labels,
    visible: Mask,
    unseen: Mask,
    among: Mask | None = None,
) -> dict[str, float]:
    """Right, wrong and missing labels at visible tokens, and labels at other tokens.

    A token is visible if more than half of its pixels show its part and the source shows them;
    hidden if more than half show its part and the source does not. Tokens that are neither, as
    those where the truth is ambiguous, count nowhere.

    ``labels.net`` ranks warps. It is the mean, over visible tokens and hidden ones that take a
    part, of +1 for the right label, 0 for none, and -1 for a wrong one or a part on a hidden token:
    of V, R, W and P tokens (R - W - P) / (V + P), from -1 to 1. The truth has 1, nothing carried 0.
    A share of right labels alone rewards a warp that also paints where it has to guess.

    Args:
        carried: (h, w) from :func:`carried_labels`.
        tokens: (h, w) true part of each token of the target, -1 outside the thing.
        pixels: (H, W) true part of each pixel.
        visible: (H, W) bool, the source certainly shows the pixel's surface.
        unseen: (H, W) bool, the source certainly does not show the pixel's surface.
        among: (h, w) bool of the counted tokens; None for all.

    Returns:
        ``labels.net``, NaN below :data:`FEWEST` visible tokens;
        ``labels.right``, ``labels.wrong`` and ``labels.none`` of visible tokens, which sum to 1;
        ``labels.painted_hidden`` of hidden tokens and ``labels.painted_outside`` of tokens outside
        the thing: those that take a part; and the counts ``labels.visible``, ``labels.hidden`` and
        ``labels.outside``. NaN where there are no such tokens.

    Raises:
        ValueError: incompatible shapes.

    Example:
        >>> import numpy as np
        >>> from attnwarp_lab.ideal.labels import label_transport
        >>> true = np.array([[0, 1, -1]], np.int16)
        >>> seen = np.array([[True, False, False]])
        >>> carried = np.array([[0, 0, -2]], np.int16)
        >>> figures = label_transport(carried, true, true, seen, ~seen)
        >>> figures["labels.right"], figures["labels.painted_hidden"]
        (1.0, 1.0)

        Of 24 visible tokens 18 right and 3 wrong, of 4 hidden ones 2 painted: 13 / 26.

        >>> true, seen = np.zeros((1, 28), np.int16), np.arange(28)[None] < 24
        >>> carried = np.array([18 * [0] + 3 * [1] + 3 * [-2] + 2 * [0] + 2 * [-2]], np.int16)
        >>> label_transport(carried, true, true, seen, ~seen)["labels.net"]
        0.5
    """
    h, w = tokens.shape
    H, W = pixels.shape
    check.shape(carried, (h, w), "carried")
    for name, array in (("visible", visible), ("unseen", unseen)):
        check.shape(array, (H, W), name)
    if H % h or W % w:
        raise ValueError(f"tokens: got {h} x {w} for {H} x {W} px, expected divisors of them")
    own = pixels == np.repeat(np.repeat(tokens, H // h, axis=0), W // w, axis=1)
    thing = tokens >= 0
    seen = thing & most(own & visible, (h, w))
    hidden = thing & most(own & unseen, (h, w))
    takes, right, none = carried >= 0, carried == tokens, carried == NONE
    kinds = {
        "visible": seen,
        "hidden": hidden,
        "outside": ~thing,
        "right": seen & right,
        "wrong": seen & ~right & ~none,
        "none": seen & none,
        "painted_hidden": hidden & takes,
        "painted_outside": ~thing & takes,
    }
    counts = {
        name: int((kind if among is None else kind & among).sum()) for name, kind in kinds.items()
    }
    painted, enough = counts["painted_hidden"], counts["visible"] >= FEWEST
    net = counts["right"] - counts["wrong"] - painted
    figures: dict[str, float] = {
        "net": share(net, counts["visible"] + painted) if enough else math.nan,
        **{name: share(counts[name], counts["visible"]) for name in ("right", "wrong", "none")},
        "painted_hidden": share(counts["painted_hidden"], counts["hidden"]),
        "painted_outside": share(counts["painted_outside"], counts["outside"]),
        **{name: counts[name] for name in ("visible", "hidden", "outside")},
    }
    return {f"labels.{name}": value for name, value in figures.items()}
