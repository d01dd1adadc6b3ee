"""Run of an editing method, as a cell's spec describes it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import Gaussians
from attnwarp.render.api import WORK as RENDERED
from attnwarp.warp import PRESETS, WarpedView, WarpSettings, warp_view
from attnwarp.warp.view import WORK
from attnwarp_eval.cost import Meter
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study.probe import Work
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import StudyError
from attnwarp_eval.study.shared.controls import OTHER_SCENE, MovedView
from attnwarp_eval.study.shared.drifts import DriftPart, drifting
from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_eval.study.shared.editing_methods import (
    EDITING_METHODS,
    Donor,
    EditedScene,
    Job,
    with_source_words,
)
from attnwarp_eval.study.shared.edits import files_digest
from attnwarp_eval.study.shared.warps import warp_truth
from attnwarp_eval.world import World, changed

if TYPE_CHECKING:
    from attnwarp.editing.editor import Editor

EDITING_PARTS = ("source", "warp", "edit")
"""Parts of a method's seconds except tuning and display."""

PARTS = (*EDITING_PARTS, "tune")
"""Parts of a method's seconds except display: renders and files are for people."""

WHOLE = "whole"
"""Stage of :class:`~attnwarp_eval.study.probe.InTurn`: all parts of an edit together."""

ROWS = "network_rows"
"""Counter of the rows of latents that pass through an editor's network."""

FLOOR = "by_view"
"""Name of the method that edits each view alone."""


def run_method(
    work: Work,
    truth: EditTruth,
    names: Sequence[str],
    before: Gaussians,
    editor: Editor | None = None,
    donor: Donor | None = None,
    segments: Sequence[npt.NDArray[np.bool_]] | None = None,
    words: Mapping[str, str] | None = None,
    warped_by: World | None = None,
) -> EditedScene:
    """Edit a scene by the method of a cell; its seconds and its work are added to the work's meter.

    Args:
        work: work of the cell, whose spec has ``method``, ``settings`` and ``editor``.
        names: names of the views, the source first.
        editor: replacement of the spec's editor.
        donor: source of the control's features; by default the other scene's source with the same
            editor.
        segments: (H, W) bool of each view, the only pixels that may change.
        words: ``instruction``, ``target`` and ``source``; by default the spec's entry ``edit``.
        warped_by: world of the spec's true geometry; by default the work's.
    """
    spec, world = work.spec, work.world
    words = spec["edit"] if words is None else words
    with work.meter.stage("setup"):
        if editor is None:
            editor = load(work.cell.sources["editor"], spec["editor"])
        other = other_world(work) if donor is None else None
        if other is not None:
            donor = Donor(editor, other.image(other.source.name, spec["spp"]))
        if "drift" in spec:
            editor = drifting(editor, DriftPart(**spec["drift"]), spec["seed"])
    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            before,
            [world.camera(name) for name in names],
            [truth.originals[name] for name in names],
            editor,
            words["target" if editor.guide == "depth" else "instruction"],
            with_source_words(spec["settings"], words["source"]),
            Path(folder),
            _warps(spec, warped_by or world, before, names),
            {a: [views[n] for n in names] for a, views in truth.answers.items()},
            donor=donor,
            segments=segments,
        )
        with _work_counted(work.meter, editor):
            result = EDITING_METHODS[spec["method"]].run(job)
    planned = {k: int(v) for k, v in result.counters.items() if k not in ("injected", ROWS)}
    work.meter.count(**planned)
    for part, seconds in result.seconds.items():
        work.meter.add(f"method: {part}", seconds)
    return result


@contextmanager
def _work_counted(meter: Meter, editor: Editor) -> Iterator[None]:
    """Count what a method does: rows that pass through the editor's network, pairs of views warped,
    and splat-pixel pairs of the surfaces rendered for them and of all renders, tuning's included.

    The method's own figure of rows is its plan, which a fault in a pass does not change.
    """
    rows = 0

    def note(_: Any, arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
        nonlocal rows
        latents = next(a for a in (*arguments, *named.values()) if isinstance(a, torch.Tensor))
        rows += len(latents)

    before, pairs = WORK.copy(), RENDERED["pairs"]
    hook = editor.network.register_forward_pre_hook(note, with_kwargs=True)
    try:
        yield
    finally:
        hook.remove()
    warped = {k: WORK[k] - before[k] for k in ("view_pairs", "pairs")}
    meter.count(**{ROWS: rows}, **warped, rendered_pairs=RENDERED["pairs"] - pairs)


def other_world(work: Work) -> World | None:
    """World of the other scene for a cell's control; None for other controls.

    Raises:
        InputError: the scene's file has changed since the cell was planned.
    """
    other = work.spec.get("other")
    if other is None:
        return None
    made = _other_world(work.cell.sources["other scene"], work.spec["size"], other["scene"])
    if made.content_hash != other["scene"]:
        raise changed(f"scene {made.scene.name!r}")
    return made


@lru_cache(maxsize=1)
def _other_world(scene: str, size: int, content: str) -> World:
    return World(load_scene(scene), size)


def own_seconds(result: EditedScene) -> float:
    """Total seconds of a method, without display."""
    return sum(result.seconds.get(part, 0.0) for part in PARTS)


@lru_cache(maxsize=2)
def _loaded(name: str, guidance: tuple[tuple[str, float], ...], draws: bool, device: str) -> Editor:
    from attnwarp.editing.small import load_editor

    given: dict[str, Any] = {f"{kind}_guidance": value for kind, value in guidance}
    if not draws:
        given["draws"] = False
    return load_editor(name, device=device, **given)


def load(name: str, planned: Json, device: str = "cpu") -> Editor:
    """Load an editor with the planned identity.

    Raises:
        StudyError: its files have changed since the run was planned.
        InputError: no such device.
    """
    if files_digest(name) != planned["sha256"]:
        raise StudyError(
            f"editor {name!r}: its files have changed since the run was planned; start the run"
            " again"
        )
    given = planned["guidance"].items()
    guidance = tuple((kind, value) for kind, value in given if value is not None)
    return _loaded(name, guidance, planned.get("draws", True), device)


def _warps(spec: Mapping[str, Any], world: World, model: Gaussians, names: Sequence[str]) -> Any:
    """Warps by exact depth, with the exact mask, or of a control; None for the method's warps."""
    control = spec.get("control")
    if control == OTHER_SCENE:  # the correct warp of wrong features
        control = None
    if spec["geometry"] == "splats" and spec["mask"] == "rules" and control is None:
        return None
    warp = spec["settings"].get("warp")
    settings = PRESETS["corrected"] if warp is None else WarpSettings.from_dict(warp)
    made: dict[tuple[int, int], WarpedView] = {}

    def of(source: int, target: int) -> WarpedView:
        if (source, target) not in made:
            pair = world.between(names[source], names[target])
            if spec["geometry"] == "truth":
                view = warp_truth(world, pair, settings)
            else:
                view = warp_view(model, pair.source, pair.target, settings, warn_empty=False)
            if spec["mask"] == "truth":
                visible = torch.from_numpy(np.ascontiguousarray(pair.visible))
                view = view.with_mask(visible)
            made[source, target] = view if control is None else MovedView.of(view, control)
        return made[source, target]

    return of


def is_alone(spec: Mapping[str, Any]) -> bool:
    """Return True if a variant's spec edits each view alone."""
    return bool(spec["method"] == FLOOR or spec["settings"].get("a0") == 0)
