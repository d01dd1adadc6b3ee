"""Overlap of a mask with the exact one: over a view, where the source saw it, and elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np

from attnwarp_eval.metrics.arrays import mask, share

LEAST_PIXELS = 16
"""Least pixels of a thing for a defined overlap: below, one pixel would weigh too much."""


def mask_overlap(
    marked: Any, thing: Any, seen: Any = None, unseen: Any = None, *, least: int = LEAST_PIXELS
) -> dict[str, float]:
    """Intersection over union, precision and recall of a mask.

    Args:
        marked: (H, W) bool, the mask to judge.
        thing: (H, W) bool, the exact mask.
        seen: (H, W) bool, pixels whose surface the source shows; None for no ``.seen`` figures.
        unseen: (H, W) bool, pixels with a surface hidden from the source; None likewise.
        least: least pixels of the thing for defined figures.

    Returns:
        ``masks.iou``, ``masks.precision``, ``masks.recall`` and the counts ``masks.union``,
        ``masks.marked`` and ``masks.thing``, over all pixels; names with ``.seen`` and ``.unseen``
        are over those pixels only. NaN if too little of the thing is visible; a precision also if
        nothing is marked.

    Raises:
        ValueError: another shape or type.

    Example:
        >>> import numpy as np
        >>> from attnwarp_eval import metrics
        >>> marked = np.array([[True, True, False, False]])
        >>> thing = np.array([[False, True, True, False]])
        >>> figures = metrics.mask_overlap(marked, thing, least=1)
        >>> figures["masks.iou"], figures["masks.recall"]
        (0.3333333333333333, 0.5)
    """
    exact = mask(thing, ("H", "W"), "thing")
    mine = mask(marked, exact.shape, "marked")
    regions = {"": np.ones(exact.shape, dtype=bool)}
    for name, pixels in (("seen", seen), ("unseen", unseen)):
        if pixels is not None:
            regions[f".{name}"] = mask(pixels, exact.shape, name)
    figures: dict[str, float] = {}
    for suffix, region in regions.items():
        counts = {
            "union": int(((mine | exact) & region).sum()),
            "marked": int((mine & region).sum()),
            "thing": int((exact & region).sum()),
        }
        both = int((mine & exact & region).sum())
        shares = {
            name: share(both, counts[of]) if counts["thing"] >= least else float("nan")
            for name, of in (("iou", "union"), ("precision", "marked"), ("recall", "thing"))
        }
        figures |= {f"masks.{name}{suffix}": value for name, value in {**shares, **counts}.items()}
    return figures
