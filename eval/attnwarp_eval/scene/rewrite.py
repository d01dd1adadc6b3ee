"""Numbers of bounces written into a scene's file without changing other text and comments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import yaml

Which = tuple[str | None, str | None]
"""Names of an edit and one of its answers; (None, None) is the scene."""


def with_bounces(text: str, numbers: Mapping[Which, int | Literal["unlimited"]]) -> str:
    """Write the numbers of bounces of a scene and its edited scenes into the text of its file.

    An edit gets a number if it differs from the scene's, or if the edit already has one.

    Example:
        >>> print(with_bounces("name: room\\nappearance: {spp: 8}  # few", {(None, None): 3}))
        name: room
        appearance: {bounces: 3, spp: 8}  # few
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    own = numbers[None, None]
    appearance = _find(root, "appearance")
    if appearance is None:
        changes = [_set(root, "appearance", f"{{bounces: {own}}}")]
    else:
        changes = [_set(appearance, "bounces", own)]
    for which, node in _edits(root):
        if which in numbers and (numbers[which] != own or _find(node, "bounces") is not None):
            changes.append(_set(node, "bounces", numbers[which]))
    # An alias repeats a node, which is changed once. From the end, so that offsets stay valid.
    places = {(start, end): new for start, end, new in changes}
    for start, end in sorted(places, reverse=True):
        text = text[:start] + places[start, end] + text[end:]
    return text


def _edits(root: Any) -> Iterator[tuple[Which, Any]]:
    """Every edit and every answer of a file, with its node."""
    for edit in getattr(_find(root, "edits"), "value", ()):
        name = getattr(_find(edit, "name"), "value", None)
        yield (name, None), edit
        for answer in getattr(_find(edit, "answers"), "value", ()):
            yield (name, getattr(_find(answer, "name"), "value", None)), answer


def _find(node: Any, name: str) -> Any:
    """The value of a key; None if absent."""
    return next((value for key, value in node.value if key.value == name), None)


def _set(node: Any, name: str, value: object) -> tuple[int, int, str]:
    """Start and end of the text that a key of a mapping replaces, and the new text."""
    there = _find(node, name)
    if there is not None:
        return there.start_mark.index, there.end_mark.index, str(value)
    if not node.value:
        return node.start_mark.index, node.end_mark.index, f"{{{name}: {value}}}"
    # Before the second key, since the first key names the entry.
    before = node.value[min(1, len(node.value) - 1)][0].start_mark
    end = ", " if node.flow_style else "\n" + " " * before.column
    return before.index, before.index, f"{name}: {value}{end}"
