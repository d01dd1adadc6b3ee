"""Denominators of shares, so that a share can be compared by its odds."""

from __future__ import annotations

from collections.abc import Mapping

_ACCEPTED = ("visible_accepted", "hidden_accepted", "outside_accepted", "empty_accepted")
_UNSEEN = ("hidden_accepted", "hidden_rejected", "outside_accepted", "outside_rejected")
_VISIBLE = ("visible_accepted", "visible_rejected")

_OCCLUSION = {
    "precision": _ACCEPTED,
    "hidden_share": _ACCEPTED,
    "behind_share": _ACCEPTED,
    "recall": _VISIBLE,
    "false_negative_rate": _VISIBLE,
    "false_positive_rate": _UNSEEN,
}

COUNTED: Mapping[str, tuple[str, ...]] = {
    **{
        f"occlusion.{name}": tuple(f"occlusion.{count}" for count in counts)
        for name, counts in _OCCLUSION.items()
    },
    **dict.fromkeys(("labels.right", "labels.wrong", "labels.none"), ("labels.visible",)),
    "labels.painted_hidden": ("labels.hidden",),
    "labels.painted_outside": ("labels.outside",),
    "masks.iou": ("masks.union",),
    "masks.precision": ("masks.marked",),
    "masks.recall": ("masks.thing",),
    "parts.seen": ("parts.seen_parts",),
    "parts.through": ("parts.hidden_pixels",),
    "parts.fill": ("parts.fill_pairs",),
    "warp.below_half_px": ("warp.visible",),
    "warp.below_1px": ("warp.visible",),
    "warp.below_2px": ("warp.visible",),
    "warp.coverage": ("warp.visible",),
}
"""Name of a share -> counts whose sum is its denominator. A suffix of a region or a grid on the
share's name applies to the counts' names too."""
