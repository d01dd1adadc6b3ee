"""Cost in time of the accuracy of the truth itself: error against seconds of pictures, depth and
visibility.

Every contestant is compared with an independent reference: pictures with the mean of many others at
far more samples, depth and visibility with a brute-force test of every triangle in float64. Seconds
are taken in turn, see :func:`attnwarp_eval.cost.in_turn`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from attnwarp.errors import InputError
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.experiments.accuracy.geometry import depth, triangles
from attnwarp_eval.experiments.accuracy.images import pictures
from attnwarp_eval.experiments.accuracy.panel import Panel, panel_spec
from attnwarp_eval.experiments.accuracy.point_visibility import visibility
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.task import Task, results

PICTURE_SCENES = ("spheres", "bear", "glass", "fog")
GEOMETRY_SCENES = ("bear", "garden", "far")

Question = Callable[..., Panel]


def measure(
    names: Sequence[str] = (), *, out: Path, rounds: int = 7, report: Reporter = SILENT
) -> Iterator[Panel]:
    """Measure every question on every scene where it applies.

    Each panel is a cell of the run's folder: an interrupted call is resumed.

    Args:
        names: scenes' names or paths; by default :data:`PICTURE_SCENES` and
            :data:`GEOMETRY_SCENES`. Scenes without triangles have closed-form geometry, and are
            skipped.

    Raises:
        InputError: a scene that cannot be used; another run is writing to ``out``.
    """
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth.mitsuba import forget

    cells = _cells([load_scene(name) for name in dict.fromkeys(names)])
    tasks = (_task(question, scene, rounds) for question, scene in cells)
    for panel in results(Store(out), tasks, len(cells), report):
        yield panel
        forget()


def _cells(scenes: Sequence[Scene]) -> list[tuple[Question, Scene]]:
    from attnwarp_eval.scene.file import load_scene

    lit = scenes or [load_scene(name) for name in PICTURE_SCENES]
    meshed = scenes or [load_scene(name) for name in GEOMETRY_SCENES]
    cells: list[tuple[Question, Scene]] = [(pictures, scene) for scene in lit]
    for scene in meshed:
        try:
            triangles(scene)
        except InputError:
            continue
        cells += [(depth, scene), (visibility, scene)]
    return cells


def _task(question: Question, scene: Scene, rounds: int) -> Task[Panel]:
    spec = panel_spec(question.__name__, scene.name, scene.content_hash, rounds)

    def compute(report: Reporter) -> Json:
        return {"panel": without_nan(asdict(question(scene, rounds=rounds, report=report)))}

    return Task(f"{scene.name}: {question.__name__}", spec, compute, Panel.from_record)
