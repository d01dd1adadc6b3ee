"""Surface seen in a view: its depth, opacity, picture and normals."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from attnwarp.warp.depth import Array


@dataclass(frozen=True, eq=False)
class Surface:
    """Depth, normals, opacity and picture of one view.

    Args:
        depth: (H, W) depth along the optical axis, NaN where undefined.
        normal: (H, W, 3) world normals of either sign and any length, NaN or zero where undefined.
        alpha: (H, W) in [0, 1]; None means opaque everywhere.
        image: (H, W, C) sRGB in [0, 1], before any edit.
        counters: work counters of the render, see :class:`attnwarp.render.Render`.

    Example:
        >>> import numpy as np
        >>> from attnwarp.warp import Surface
        >>> wall = Surface(np.full((8, 8), 2.0), np.broadcast_to([0.0, 0, -1], (8, 8, 3)))
        >>> wall.depth.shape, wall.alpha is None  # enough for exact depth
        ((8, 8), True)
    """

    depth: Array
    normal: Array | None = None
    alpha: Array | None = None
    image: Array | None = None
    counters: dict[str, int] = field(default_factory=dict)

    def __repr__(self) -> str:
        parts = ("depth", "normal", "alpha", "image")
        given = ", ".join(part for part in parts if getattr(self, part) is not None)
        return f"Surface({tuple(np.shape(self.depth))}: {given})"


def needed(value: Array | None, name: str, rule: str) -> Array:
    """Return a part of a surface that a rule requires.

    Raises:
        ValueError: the part is missing; the message names the rule.
    """
    if value is None:
        raise ValueError(
            f"{name}: got None, but the rule {rule} needs it; give it or turn the rule off"
        )
    return value
