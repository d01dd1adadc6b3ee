"""Distance of figures of consistency along optical flow from those at exact correspondences.

For each scene and yaw: the disagreement of two views on the edited object, exact and along optical
flow, of four pairs of pictures whose consistency is known. The unedited truth and an edit with one
answer in both views are as consistent as the scene. The third pair has the target of the second
moved by 2 px. The fourth, with a different answer in each view, is as inconsistent as can be.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.errors import InputError
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.experiments.overwriting import check_nothing_is_lost
from attnwarp_eval.files import write_picture
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.record import Json, with_nan
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.task import Task, results
from attnwarp_eval.world import turned

Method = Literal["dis", "farneback"]

PROTOCOL = 1
"""Raised whenever the same inputs would give other rows."""

SCENES = {"bear": "some_colour", "dinosaur": "some_colour", "person": "some_jacket"}
"""Scenes, and an edit of each with several right answers."""

SLIP = 2
"""Pixels by which the target is moved sideways for the pair "slip": an edit whose details are a
little out of place.
"""

PAIRS = ("truth", "one_answer", "slip", "two_answers")
"""Contents of the two views: the scene unedited; edited with one answer; the same, the target moved
by :data:`SLIP`; the source with one answer, the target with another.
"""


@dataclass(frozen=True)
class Row:
    """One scene, yaw and flow method; keys are those of
    :data:`attnwarp_eval.metrics.registry.METRICS`.

    Attributes:
        figures: by what the two views show (:data:`PAIRS`), exact figures, flow figures
            (``flow_``), what separates them (``flow_gap_``), and flow figures at the pixels of the
            exact ones (``flow_same_``).
        flow: the endpoint error of the flow and its check, whole picture.
    """

    scene: str
    yaw: float
    method: str
    figures: dict[str, dict[str, float]]
    flow: dict[str, float]


@dataclass(frozen=True)
class Options:
    """Settings of a row's measurement.

    Attributes:
        size: of the square pictures, px.
        spp: samples a pixel.
        method: of optical flow, see :func:`attnwarp_eval.metrics.optical_flow`.
        pictures: whether the pictures of each pair are kept.
    """

    size: int = 256
    spp: int = 32
    method: Method = "dis"
    pictures: bool = True


def measure(
    scenes: Sequence[str],
    yaws: Sequence[float],
    out: Path,
    options: Options,
    *,
    report: Reporter = SILENT,
) -> Iterator[Row]:
    """The rows of scenes and yaws, in this order.

    Each row is a cell of the run's folder: a call that was killed goes on where it was.

    Args:
        scenes: names among :data:`SCENES`.
        yaws: degrees from the source.
        out: the run's folder, which also takes the pictures.

    Raises:
        InputError: another scene than :data:`SCENES`; another run is writing to ``out``, or rows of
            its ``flow.json`` would be lost.
    """
    if options.method not in get_args(Method):
        raise InputError(
            f"--method: got {options.method!r}, expected one of {', '.join(get_args(Method))}"
        )
    for name in scenes:
        if name not in SCENES:
            raise InputError(f"scene {name!r}: expected one of {', '.join(SCENES)}")
    asked = {(name, str(float(yaw)), options.method) for name in scenes for yaw in yaws}
    check_nothing_is_lost(out / "flow.json", None, ("scene", "yaw", "method"), asked)
    store = Store(out)
    tasks = (_task(store, name, float(yaw), options) for name in scenes for yaw in yaws)
    yield from results(store, tasks, len(scenes) * len(yaws), report)


def _task(store: Store, name: str, yaw: float, options: Options) -> Task[Row]:
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth.llvm import variant
    from attnwarp_eval.truth.mitsuba import APPEARANCE_PROTOCOL

    spec = {
        "probe": "flow",
        "protocol": [PROTOCOL, APPEARANCE_PROTOCOL],
        "variant": variant(),
        "scene": load_scene(name).content_hash,
        "edit": SCENES[name],
        "yaw": yaw,
        **asdict(options),
    }

    def compute(report: Reporter) -> Json:
        pictures = []

        def keep(kind: str, image: npt.NDArray[np.float64]) -> None:
            path = write_picture(store.root / f"{name}-{yaw:g}-{kind}.png", image)
            pictures.append(store.keep_picture(path, view=f"{yaw:g}", what=kind))

        row = measure_pair(name, SCENES[name], yaw, options, keep if options.pictures else None)
        return {"row": without_nan(asdict(row)), "pictures": pictures}

    return Task(f"{name}, {yaw:g} degrees", spec, compute, _row)


def _row(record: Json) -> Row:
    row = record["row"]
    figures = {kind: with_nan(row["figures"][kind]) for kind in PAIRS}
    return Row(row["scene"], row["yaw"], row["method"], figures, with_nan(row["flow"]))


@lru_cache(maxsize=1)
def _edited(name: str, edit: str, size: int) -> tuple[dict[str, Scene], list[str], Any]:
    """A scene before the edit ("truth") and with its first and last answer, the names of these two,
    and its geometry.
    """
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth import Geometry

    scene = load_scene(name).with_size(size, size)
    answers = [answer.name for answer in scene.edit(edit).answers]
    if len(answers) < 2:
        raise ValueError(
            f"edit {edit!r} of {scene.name!r}: got one result, expected at least two answers"
        )
    ends = [answers[0], answers[-1]]
    scenes = {"truth": scene, **{answer: scene.edited(edit, answer) for answer in ends}}
    return scenes, ends, Geometry(scene)


def measure_pair(
    name: str,
    edit: str,
    yaw: float,
    options: Options,
    keep: Callable[[str, npt.NDArray[np.float64]], object] | None = None,
) -> Row:
    """The row of one scene and yaw.

    Args:
        name: of the scene, or its path.
        edit: one with at least two answers, which changes objects and not the light.
        yaw: degrees from the source.
        keep: given the kind of each pair and (H, W, 3) sRGB pictures to look at.

    Raises:
        ValueError: an edit with one result.
    """
    from attnwarp_eval import metrics
    from attnwarp_eval.truth import appearance, to_srgb, two_view
    from attnwarp_eval.truth.edits import edit_mask

    scenes, (first, last), geometry = _edited(name, edit, options.size)
    scene = scenes["truth"]
    camera = turned(scene, yaw)

    def picture(world: str, of: Camera) -> Any:
        # Appearance is cached on disk, so that the source is rendered once for all yaws.
        return to_srgb(appearance(scenes[world], of, spp=options.spp))

    source = {world: picture(world, scene.source) for world in ("truth", first)}
    target = {world: picture(world, camera) for world in scenes}
    pair = two_view(geometry, scene.source, camera)
    # One object for all pairs, that of the first answer: answers may change others besides.
    mask = edit_mask(scene, edit, pair.hits, first)
    flow = metrics.optical_flow(source["truth"], target["truth"], options.method)
    images = {
        "truth": (source["truth"], target["truth"]),
        "one_answer": (source[first], target[first]),
        "slip": (source[first], np.roll(target[first], SLIP, axis=1)),
        "two_answers": (source[first], target[last]),
    }
    figures = {}
    for kind, (one, other) in images.items():
        exact = metrics.cross_view(one, other, pair, mask=mask)
        by_flow = metrics.flow_consistency(one, other, flow, mask=mask)
        same = metrics.flow_consistency(one, other, flow, mask=exact.counted)
        figures[kind] = {
            **exact.figures(),
            **by_flow.figures("flow_"),
            **same.figures("flow_same_"),
            **metrics.approximation_error(exact, by_flow),
        }
        if keep is not None:
            keep(kind, _sheet(one, other, exact.delta_e, by_flow.delta_e))
    return Row(scene.name, yaw, options.method, figures, metrics.flow_error(flow, pair))


def _sheet(source: Any, target: Any, exact: Any, flow: Any) -> Any:
    """Source, target, exact DeltaE and DeltaE along the flow, side by side: black 0, white 40 and
    beyond, blue not counted.
    """
    maps = []
    for delta_e in (exact, flow):
        grey = np.repeat(np.clip(np.nan_to_num(delta_e) / 40, 0, 1)[..., None], 3, axis=-1)
        maps.append(np.where(np.isnan(delta_e)[..., None], [0.1, 0.15, 0.35], grey))
    return np.concatenate([source, target, *maps], axis=1)
