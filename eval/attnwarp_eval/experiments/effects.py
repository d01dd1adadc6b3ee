"""The table of effects as a run that can be interrupted: every scene is a cell."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from attnwarp_eval.effects import table
from attnwarp_eval.effects.table import Settings, measure_entry, page, side_by_side
from attnwarp_eval.progress import Progress, silent
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.store import Store

PROTOCOL = 2
"""Raised whenever an entry would come out otherwise."""


def collect(
    names: Sequence[str], out: Path, settings: Settings, progress: Progress = silent
) -> list[dict[str, Any]]:
    """Make the table's entries and write them, with their pictures, below ``out``.

    Each entry is a cell of the run's folder, and so are its pictures. After an interruption, or
    when one scene has changed, only what is missing is made.

    Args:
        names: scenes' names or paths.
        out: folder of ``effects.json``, ``effects.md``, ``<scene>.jpg`` and ``cells/``.
        settings: how an entry is made.
        progress: told of each step of each scene.

    Returns:
        The entries, as they stand in ``effects.json``.

    Raises:
        InputError: a scene that is unknown or contradicts itself, an ``effects.json`` of something
            else, or another run that is writing to ``out``.
    """
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth.mitsuba import forget

    # Scenes of an earlier call stay in the file; the table is of those asked for, as far as they
    # are done.
    available = _read(out / "effects.json")
    entries = []
    store = Store(out)
    with store.lock():
        for number, name in enumerate(names):

            def tell(step: str, number: int = number) -> None:
                progress(number, len(names), step)

            scene = load_scene(name)
            entry = _entry(scene, store, settings, tell)
            available[scene.name] = entry
            entries.append(entry)
            _write(out, available, entries)
            forget()
    return entries


def _entry(
    scene: Scene, store: Store, settings: Settings, progress: Callable[[str], None]
) -> dict[str, Any]:
    """The entry of a scene, with what is finished of it read from the store."""
    entry = _resumed(
        store,
        {"probe": "effects", "prove": settings.prove, "budget": settings.budget}
        | {"rounds": settings.rounds},
        scene,
        lambda: {"entry": measure_entry(scene, settings, progress)},
    )["entry"]
    if settings.pictures:
        progress(f"{scene.name}: pictures")

        def pictures() -> dict[str, Any]:
            path = store.root / entry["picture"]
            about = side_by_side(scene, path)
            saved = [store.keep_picture(path, view=scene.source.name, what="side by side")]
            return {"about": about, "pictures": saved}

        samples = {"size": table.PICTURE_SIZE, "plan": table.PLAN_SAMPLES}
        samples |= {"everything_on": table.FULL_SAMPLES}
        entry |= _resumed(store, {"probe": "effects, pictures", **samples}, scene, pictures)[
            "about"
        ]
    return dict(entry)


def _resumed(
    store: Store, own: dict[str, Any], scene: Scene, compute: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """A record of what ``own`` and the scene decide, with this version of Mitsuba."""
    import mitsuba

    from attnwarp_eval.truth.llvm import variant
    from attnwarp_eval.truth.mitsuba import APPEARANCE_PROTOCOL

    spec = {
        **own,
        "protocol": [PROTOCOL, APPEARANCE_PROTOCOL],
        "mitsuba": mitsuba.__version__,
        "variant": variant(),
        "scene": scene.content_hash,
        "name": scene.name,
    }
    return store.resumed(spec, compute)


def _read(path: Path) -> dict[str, dict[str, Any]]:
    from attnwarp.errors import InputError

    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    try:
        return {
            entry["scene"]: entry
            for entry in json.loads(text)["scenes"]
            if entry["plan"] and entry["picture"]
        }
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: it is not a table of effects; name another folder with --out, or remove the"
            " file"
        ) from None


def _write(out: Path, available: Mapping[str, Any], asked: Sequence[Mapping[str, Any]]) -> None:
    from attnwarp_eval.canonical_json import write_json
    from attnwarp_eval.cost import environment
    from attnwarp_eval.files import write_atomic

    data: dict[str, Any] = {
        "environment": environment(),
        "scenes": [available[name] for name in sorted(available)],
    }
    write_json(out / "effects.json", data, sort_keys=False)
    write_atomic(out / "effects.md", page(asked, data["environment"]).encode())
