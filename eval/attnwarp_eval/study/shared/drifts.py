"""Planted drift: an editor that moves every picture it edits, by a known similarity."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from attnwarp.digest import digest
from attnwarp_eval.study.schema import Part

Motion = tuple[float, float, float, float]
"""Right and down in px, percent larger, degrees clockwise as displayed, about the middle."""


class DriftPart(Part):
    """Drift of every view by the editor, in a direction and with signs of the view's own.

    ``shift`` in px of the picture, ``scale`` in percent, ``turn`` in degrees.
    """

    shift: Annotated[float, Field(ge=0)] = 0.0
    scale: Annotated[float, Field(ge=0, lt=100)] = 0.0
    turn: Annotated[float, Field(ge=0, le=180)] = 0.0

    def motion(self, picture: npt.NDArray[Any], seed: int) -> Motion:
        """Motion of a picture: the same whenever the picture is edited.

        Args:
            picture: (H, W, C) the picture before the edit.
        """
        own = digest(np.asarray(picture, dtype=np.float32))
        draw = np.random.default_rng([seed, int(own[:8], 16)])
        angle, signs = draw.uniform(0, 2 * np.pi), draw.choice([-1, 1], 2)
        return (
            self.shift * float(np.cos(angle)), self.shift * float(np.sin(angle)),
            self.scale * float(signs[0]), self.turn * float(signs[1]),
        )  # fmt: skip


def moved(
    picture: npt.NDArray[Any], motion: Motion, interpolation: int = cv2.INTER_CUBIC
) -> npt.NDArray[Any]:
    """(H, W) or (H, W, C) the picture after a motion; beyond its border, the border's pixels.

    Args:
        picture: picture, at least as large as the motion's shift.
        motion: motion about the picture's middle.
        interpolation: OpenCV's flag; cubic values are clipped to the picture's range.

    Example:
        >>> picture = np.zeros((5, 5)); picture[2, 1] = 1
        >>> np.argwhere(moved(picture, (2, 0, 0, 0)) > 0.5).tolist()
        [[2, 3]]
    """
    right, down, percent, degrees = motion
    h, w = picture.shape[:2]
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    linear = (1 + percent / 100) * np.array([[cos, -sin], [sin, cos]])
    middle = np.array([w - 1, h - 1]) / 2
    affine = np.c_[linear, middle + np.array([right, down]) - linear @ middle]
    result = cv2.warpAffine(
        picture, affine, (w, h), flags=interpolation, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(np.clip(result, picture.min(), picture.max()), dtype=picture.dtype)


def drifting(editor: Any, drift: DriftPart, seed: int) -> Any:
    """Copy an editor, which then edits every guide as if it lay elsewhere.

    What it starts from stays in place, as with an editor that pulls a picture aside.

    Args:
        editor: an :class:`attnwarp.editing.editor.Editor`.
    """

    class Drifting(type(editor)):  # type: ignore[misc]
        def task(self, guides: Sequence[Any], *rest: Any, **named: Any) -> Any:
            return super().task(
                [moved(guide, drift.motion(guide, seed)) for guide in guides], *rest, **named
            )

    made = copy.copy(editor)
    made.__class__ = Drifting
    return made
