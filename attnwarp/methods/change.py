"""Measured change and drift of an edit, and advice if the change is negligible."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from attnwarp.colors import ciede2000, to_lab
from attnwarp.drift import Drift, NoDrift, drift_or_why
from attnwarp.methods.pictures import Bytes, Image, Mask, Size, resized, to_bytes
from attnwarp.methods.work import Work

LITTLE = 3.0
"""dE00 inside the mask below which an edit is hardly seen. Two pictures side by side differ visibly
from about 1; rounding, tuning and an unchanged source account for up to 2."""

MOST_PIXELS = 20_000
"""Compared pixels per view, evenly spread; more pixels would change no displayed digit."""

MOST_DRIFTS = 4
"""Number of views whose drift is measured if no view is the source."""

Change = Mapping[str, float | None]
"""Mean CIEDE2000 of "scene" and of "source view", or of "edited views" for a method without a
source; None if no pixel counts."""


def change_of(
    work: Work, names: Sequence[str], source: str | None, edited: Mapping[int, Bytes]
) -> Change:
    """Measure the change inside the mask of an edit whose renders are written.

    Args:
        source: name of the source view, excluded from the scene's change; None for no source.
    """
    segments = work.segments

    def mask(view: int, size: Size, kept: Mask | None = None) -> Mask | None:
        parts = [] if segments is None else [segments[view] > 0.5]
        parts += [] if kept is None else [kept]
        if not parts:
            return None
        inside = np.logical_and.reduce(parts).astype(np.float32)
        return np.asarray(resized(inside[..., None].repeat(3, 2), size)[..., 0] > 0.5)

    def rendered(views: Iterable[int]) -> float | None:
        read = work.folder.read_picture
        return mean_change(
            (before := read(f"renders/before/{names[view]}.png"),
             read(f"renders/after/{names[view]}.png"), mask(view, before.shape[:2]))
            for view in views
        )  # fmt: skip

    def edit(view: int) -> tuple[Bytes, Bytes, Mask | None]:
        size = edited[view].shape[:2]  # a method may return another size than requested
        before = resized(work.views.picture(view), size)
        return to_bytes(before), edited[view], mask(view, size, work.views.masks[view])

    views = range(len(names))
    scene = rendered(view for view in views if names[view] != source)
    edits = [view for view in edited if source in (None, names[view])]
    return {
        "scene": rendered(views) if scene is None else scene,
        "source view" if source else "edited views": mean_change(map(edit, edits)),
    }


def drift_of(work: Work, view: int, picture: Image) -> dict[str, Any]:
    """Measure how far an editor moved what lies outside the mask.

    Args:
        picture: (h, w, 3) its edit, before it is composed with the original outside the mask.

    Returns:
        Attributes of a :class:`attnwarp.drift.Drift` or :class:`attnwarp.drift.NoDrift`.
    """
    size, segments = picture.shape[:2], work.segments
    left = None
    if segments is not None:
        touched = np.asarray(segments[view] > 0, np.float32)[..., None].repeat(3, 2)
        left = resized(touched, size)[..., 0] == 0
    before = to_bytes(resized(work.views.picture(view), size))
    return asdict(drift_or_why(before, to_bytes(picture), left))


def say_drift(edit: Mapping[str, Any]) -> tuple[str, bool]:
    """Write a line about the drift of an edit, and whether it warns."""
    if not edit["view"]:
        return "no view was edited", False
    told = edit["drift"]
    if told is None or told.get("why"):  # runs before the reason was kept have none
        why = f": {told['why']}" if told else ""
        return f"whether the edit of {edit['view']} moved the picture can't be told{why}", False
    found = Drift(**told) if "right" in told else NoDrift(**told)
    if isinstance(found, Drift) and not found.seen:
        return f"the edit of {edit['view']} left the picture in place ({found})", False
    how = f"corners by {found.largest:.1f} px ({found})" if isinstance(found, Drift) else found
    return (
        f"the edit of {edit['view']} moved the picture, {how}; warps assume that it stays: try"
        " another seed or editor"
    ), True


def mean_change(pictures: Iterable[tuple[Bytes, Bytes, Mask | None]]) -> float | None:
    """Average CIEDE2000 between pictures before and after, over all pixels of all views.

    Args:
        pictures: (h, w, 3) uint8 of a view before, after, and (h, w) bool of the counted pixels,
            None for all.

    Returns:
        dE00; None if no pixel counts.

    Example:
        >>> import numpy as np
        >>> white, black = (np.full((2, 2, 3), value, np.uint8) for value in (255, 0))
        >>> left = np.array([[True, False]] * 2)
        >>> half = np.where(left[..., None], black, white)
        >>> round(mean_change([(white, half, left)])), round(mean_change([(white, half, None)]))
        (100, 50)
    """
    total, count = 0.0, 0
    for before, after, mask in pictures:
        inside = np.ones(before.shape[:2], bool) if mask is None else mask
        n = int(inside.sum())
        one, two = (v[inside][:: 1 + n // MOST_PIXELS] for v in (before, after))
        if n:
            total += n * float(ciede2000(to_lab(one), to_lab(two)).mean())
            count += n
    return total / count if count else None


def say_change(change: Change, masked: bool) -> str:
    """Write the first line of an edit's page and of its command's output.

    Example:
        >>> say_change({"scene": 9.04, "source view": 20.5}, masked=True)
        'inside the mask the scene changed by 9.0 dE00, the source view by 20.5'
    """
    (_, scene), (name, edit) = change.items()
    where = "inside the mask the" if masked else "the"
    return f"{where} scene changed by {_short(scene)} dE00, the {name} by {_short(edit)}"


def say_little(change: Change) -> str | None:
    """Return advice if the change is negligible, else None.

    Example:
        >>> say_little({"scene": 0.4, "source view": 20.5})
        'the splats hardly took the edit: try more --iterations or --stages'
    """
    (_, scene), (name, edit) = change.items()
    if edit is not None and edit < LITTLE:
        return (
            f"the editor hardly changed the {name}: try other words, a larger --set"
            " text_guidance=N, or another --editor; a mask must hold what the words name"
        )
    if scene is not None and scene < LITTLE:
        return "the splats hardly took the edit: try more --iterations or --stages"
    return None


def _short(value: float | None) -> str:
    return "nothing" if value is None else f"{value:.1f}"
