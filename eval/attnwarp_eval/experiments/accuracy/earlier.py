"""Panels that earlier calls measured in the same folder."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from functools import cache
from pathlib import Path

from attnwarp_eval.experiments.accuracy.panel import QUESTIONS, Panel, panel_spec
from attnwarp_eval.experiments.overwriting import Key, check_nothing_is_lost
from attnwarp_eval.scene.scene import SceneError
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.store import Store


def check_overwriting(out: Path, asked: Collection[Key]) -> None:
    """Check that accuracy.json has no panel that is neither asked for nor stored.

    Args:
        out: the run's folder.
        asked: question and scene of each panel that the call measures.

    Raises:
        InputError: a panel would be lost.
    """
    available = {*asked, *_stored(Store(out))}
    check_nothing_is_lost(out / "accuracy.json", "panels", ("question", "scene"), available)


def with_earlier(panels: Sequence[Panel], store: Store) -> tuple[list[Panel], list[Key]]:
    """The panels, with those of other questions and scenes that are stored, in a fixed order.

    Of several panels of one scene the one of the most rounds is taken.

    Args:
        panels: what the call measured.
        store: of the run's folder.

    Returns:
        The panels by question and scene, and question and scene of those that are left out: they
        were measured with other versions, another variant, or of another content of the scene.
    """
    asked, content = {(panel.question, panel.scene) for panel in panels}, cache(_content)
    earlier, left_out = [], []
    for key, stored in _stored(store).items():
        if key in asked:
            continue
        current = [(spec, panel) for spec, panel in stored if _is_current(spec, content)]
        # A scene's file that has only a path cannot be asked which of two contents is today's.
        if len({spec["scene"] for spec, _ in current}) == 1:
            earlier.append(max(current, key=lambda pair: pair[0]["rounds"])[1])
        else:
            left_out.append(key)
    return (
        sorted([*earlier, *panels], key=lambda panel: _place((panel.question, panel.scene))),
        sorted(left_out, key=_place),
    )


def _place(key: Key) -> tuple[int, str]:
    return QUESTIONS.index(key[0]), key[1]


def _stored(store: Store) -> dict[Key, list[tuple[Json, Panel]]]:
    """Specs and panels of the whole cells, by question and scene."""

    def read(record: Json) -> tuple[Json, Panel]:
        panel, spec = Panel.from_record(record), record["spec"]
        if (spec["question"], spec["name"]) != (panel.question, panel.scene):
            raise ValueError("the panel is not the one that the spec names")
        if panel.question not in QUESTIONS:
            raise ValueError(f"unknown question {panel.question!r}")
        return spec, panel

    panels: dict[Key, list[tuple[Json, Panel]]] = defaultdict(list)
    for cell_id in sorted(store.done()):
        result = store.whole(cell_id, read)
        if result is not None:
            panels[result[1].question, result[1].scene].append(result)
    return panels


def _is_current(spec: Json, content: Callable[[str], str | None]) -> bool:
    """Return True if a panel would have the same spec if it was measured now."""
    name = spec["name"]
    return spec == panel_spec(
        spec["question"], name, content(name) or spec["scene"], spec["rounds"]
    )


def _content(name: str) -> str | None:
    """The hash of a scene that can be loaded by its name."""
    from attnwarp_eval.scene.file import load_scene

    try:
        return load_scene(name).content_hash
    except SceneError:
        return None
