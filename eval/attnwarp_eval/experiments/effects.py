"""Table of effects as a resumable run with two cells for every scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.canonical_json import write_json
from attnwarp_eval.cost import environment
from attnwarp_eval.document.write import write_files
from attnwarp_eval.effects import table
from attnwarp_eval.effects.table import Settings, measure_entry, side_by_side
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.task import Task, results

PROTOCOL = 2
"""Version; raised when an entry's content changes."""

Part = tuple[str, dict[str, Any]]
"""A scene's name, and some fields of its entry."""


def collect(
    names: Sequence[str], out: Path, settings: Settings, report: Reporter = SILENT
) -> list[dict[str, Any]]:
    """Compute the table's entries and write them, with their pictures, below ``out``.

    Each entry is a cell of the run's folder, and so are its pictures. After an interruption, or
    when one scene has changed, only missing cells are computed.

    Args:
        names: scenes' names or paths.
        out: folder of ``effects.json``, the report, ``<scene>.jpg`` and ``cells/``.

    Raises:
        InputError: a scene that is unknown or contradicts itself, or another run that is writing to
            ``out``.
    """
    from attnwarp_eval.scene.file import load_scene

    store = Store(out)
    scenes = [load_scene(name) for name in dict.fromkeys(names)]
    tasks, parts = _tasks(scenes, store, settings), 1 + settings.pictures
    entries: dict[str, dict[str, Any]] = {}
    for name, part in results(store, tasks, len(scenes) * parts, report):
        entries.setdefault(name, {}).update(part)
        # Finished entries can be read while the others are computed.
        about = environment()
        data = {"environment": about, "scenes": [entries[name] for name in sorted(entries)]}
        write_json(out / "effects.json", data, sort_keys=False)
        write_files(table.report(list(entries.values()), about), out, "effects")
    return list(entries.values())


def _tasks(scenes: Sequence[Scene], store: Store, settings: Settings) -> Iterator[Task[Part]]:
    from attnwarp_eval.truth.mitsuba import forget

    for scene in scenes:
        yield _entry(scene, settings)
        forget()
        if settings.pictures:
            yield _pictures(scene, store)
            forget()


def _entry(scene: Scene, settings: Settings) -> Task[Part]:
    spec = {"probe": "effects", "prove": settings.prove, "budget": settings.budget}
    spec |= {"rounds": settings.rounds}

    def compute(report: Reporter) -> Json:
        return {"entry": measure_entry(scene, settings, report)}

    return Task(
        f"{scene.name}: effects", _common(scene) | spec, compute, lambda r: (scene.name, r["entry"])
    )


def _pictures(scene: Scene, store: Store) -> Task[Part]:
    spec = {"probe": "effects, pictures", "size": table.PICTURE_SIZE, "plan": table.PLAN_SAMPLES}
    spec |= {"everything_on": table.FULL_SAMPLES}

    def compute(report: Reporter) -> Json:
        path = store.root / f"{scene.name}.jpg"
        about = side_by_side(scene, path)
        saved = store.keep_picture(path, view=scene.source.name, what="side by side")
        return {"about": about, "pictures": [saved]}

    return Task(
        f"{scene.name}: pictures",
        _common(scene) | spec,
        compute,
        lambda r: (scene.name, r["about"]),
    )


def _common(scene: Scene) -> Json:
    """Entries of both specs: the scene and this version of Mitsuba."""
    import mitsuba

    from attnwarp_eval.truth.llvm import variant
    from attnwarp_eval.truth.mitsuba import APPEARANCE_PROTOCOL

    return {
        "protocol": [PROTOCOL, APPEARANCE_PROTOCOL],
        "mitsuba": mitsuba.__version__,
        "variant": variant(),
        "scene": scene.content_hash,
        "name": scene.name,
    }
