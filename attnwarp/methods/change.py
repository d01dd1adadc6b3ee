"""Measured change and drift of an edit, and advice if the change is negligible."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from attnwarp.colors import ciede2000, to_lab
from attnwarp.methods.pictures import Bytes, Image, Mask, resized, to_bytes
from attnwarp.methods.work import Work

LITTLE = 3.0
"""dE00 inside the mask below which an edit is hardly seen. Two pictures side by side differ visibly
from about 1; rounding, tuning and an unchanged source account for up to 2."""

HARDLY_ALL = 0.8
"""Share of its edit that a scene may miss without a word."""

MOST_PIXELS = 20_000
"""Compared pixels per view, evenly spread; more pixels would change no displayed digit."""

MOST_DRIFTS = 4
"""Number of views whose drift is measured if no view is the source."""

Change = Mapping[str, Any]
"""Change by an edit, inside the mask; None where no pixel counts.

"scene": mean CIEDE2000 of the scene, net of what tuning alone changes. "source view", or "edited
views" for a method without a source: that of its edit. "changed": share of the pixels whose net
change is seen. "worst": name of the view that took the least share of its edit, and the share.
"""


def change_of(
    work: Work, names: Sequence[str], source: str | None, edited: Mapping[int, Bytes]
) -> Change:
    """Measure the change inside the mask of an edit whose renders are written.

    Args:
        source: name of the source view, excluded from the scene's change; None for no source.
    """
    segments = work.segments

    def views() -> Iterable[tuple[str, list[Any]]]:
        for view, after in edited.items():
            size = after.shape[:2]  # a method may return another size than requested
            inside, kept = np.ones(size, bool), work.views.masks[view]
            for part in (None if segments is None else segments[view] > 0.5, kept):
                if part is not None:
                    mask = np.asarray(part, np.float32)[..., None].repeat(3, 2)
                    inside &= resized(mask, size)[..., 0] > 0.5
            read = [
                work.folder.read_picture(f"renders/{when}/{names[view]}.png").astype(np.float32)
                / np.float32(255)
                for when in ("before", "after")
            ]
            pictures = [
                to_bytes(resized(work.views.picture(view), size)), after,
                *(to_bytes(resized(picture, size)) for picture in read),
            ]  # fmt: skip
            step = 1 + int(inside.sum()) // min(MOST_PIXELS, 1_000_000 // len(edited) + 1)
            yield names[view], [to_lab(picture[inside][::step]) for picture in pictures]

    return net_change(dict(views()), source)


def net_change(views: Mapping[str, Sequence[Any]], source: str | None) -> Change:
    """Measure how much of an edit a scene took, apart from what tuning alone changes.

    Renders go from before to after by a share of the edit and a share of the splats' misfit, since
    tuning brings them nearer to the photographs, too. Least squares over all pixels tell the two
    apart.

    Args:
        views: (N, 3) CIELAB of a view's counted pixels: photograph, edit, render before and after.
        source: name of the source view, excluded from the scene's change; None for no source.

    Example:
        >>> import numpy as np
        >>> photograph = np.random.default_rng(0).uniform(20, 60, (500, 3))
        >>> edit, before = photograph + [20, 0, 0], photograph + [0, 9, 0]
        >>> after = photograph + [10, 0, 0]  # half of the edit, and all of the misfit's end
        >>> change = net_change({"a": (photograph, edit, before, after)}, None)
        >>> round(change["scene"] / change["edited views"], 2), change["changed"]
        (0.5, 1.0)
    """
    normal, right = 1e-9 * np.eye(2), np.zeros(2)
    counted = {name: view for name, view in views.items() if len(view[0])}
    scene = {name: view for name, view in counted.items() if name != source} or counted
    for photograph, edit, before, after in scene.values():
        columns = np.stack([edit - photograph, photograph - before]).reshape(2, -1)
        normal += columns @ columns.T
        right += columns @ (after - before).ravel()
    share, misfit = np.linalg.solve(normal, right)
    sizes = {name: ciede2000(view[0], view[1]) for name, view in counted.items()}
    asked = {name: float(values.mean()) for name, values in sizes.items()}
    weights, taken, seen = {}, {}, 0
    for name, (photograph, edit, before, after) in scene.items():
        change = edit - photograph
        along = ((after - before - misfit * (photograph - before)) * change).sum(-1)
        square = (change**2).sum(-1)
        seen += int((along * sizes[name] >= LITTLE * np.maximum(square, 1e-9)).sum())
        weights[name] = len(change)
        if asked[name] >= LITTLE:
            taken[name] = float(along.sum() / square.sum())
    total = sum(weights.values())
    edits = sum(asked[name] * n for name, n in weights.items())
    worst = min(taken, key=lambda name: taken[name], default=None)
    own = asked.get(source or "") if source else edits / total if total else None
    return {
        "scene": max(0.0, float(share)) * edits / total if total else None,
        "source view" if source else "edited views": own,
        "changed": seen / total if total else None,
        "worst": None if worst is None or len(taken) < 2 else [worst, taken[worst]],
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
    from attnwarp.drift import drift_or_why

    return asdict(drift_or_why(before, to_bytes(picture), left))


def say_drift(edit: Mapping[str, Any]) -> tuple[str, bool]:
    """Write a line about the drift of an edit, and whether it warns."""
    if not edit["view"]:
        return "no view was edited", False
    told = edit["drift"]
    if told is None or told.get("why"):  # runs before the reason was kept have none
        why = f": {told['why']}" if told else ""
        return f"whether the edit of {edit['view']} moved the picture can't be told{why}", False
    from attnwarp.drift import Drift, NoDrift

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
        >>> change = {"scene": 9.04, "source view": 20.5, "changed": 0.6, "worst": ["a", 0.12]}
        >>> print(say_change(change, masked=True).replace(": ", ":\\n").replace("; ", ";\\n"))
        inside the mask the scene changed by 9.0 dE00, net of tuning, the source view by 20.5:
        the scene took 44 % of that;
        60 % of the mask changed;
        a took least, 12 % of its edit
    """
    (_, scene), (name, edit) = [*change.items()][:2]
    where = "inside the mask the" if masked else "the"
    line = (
        f"{where} scene changed by {_short(scene)} dE00, net of tuning, the {name} by"
        f" {_short(edit)}"
    )
    if scene is not None and edit and scene < HARDLY_ALL * edit:
        line += f": the scene took {100 * scene / edit:.0f} % of that"
    if change["changed"] is not None:
        whole = "mask" if masked else "pictures"
        line += f"; {100 * change['changed']:.0f} % of the {whole} changed"
    if change["worst"] is not None:
        view, share = change["worst"]
        line += f"; {view} took least, {100 * max(0.0, share):.0f} % of its edit"
    return line


def say_little(change: Change) -> str | None:
    """Return advice if the change is negligible, else None.

    Example:
        >>> say_little({"scene": 0.4, "source view": 20.5})
        'the splats hardly took the edit: try more --iterations or --stages'
    """
    (_, scene), (name, edit) = [*change.items()][:2]
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
