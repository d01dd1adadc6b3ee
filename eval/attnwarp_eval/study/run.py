"""Run a study's cells, and verify a run. Every finished cell is on disk at once."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from attnwarp.errors import InputError
from attnwarp.process import core_count
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.cost import environment
from attnwarp_eval.plugins import VARIABLE, load_plugins, plugin_modules
from attnwarp_eval.scene.base import silence_notices
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.notices import notices
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.cluster import run_on_scheduler, run_on_workers
from attnwarp_eval.study.computations import check_keys
from attnwarp_eval.study.probe import probe, probes
from attnwarp_eval.study.record import Environment, Failure
from attnwarp_eval.study.reporting import CellReporter
from attnwarp_eval.study.schema import Study, StudyError, did_you_mean
from attnwarp_eval.study.store import Problems, Store, StoreError
from attnwarp_eval.study.study import cells_of, explain_errors, parse_study, scene_files
from attnwarp_eval.study.work import compute_and_write
from attnwarp_eval.truth.plan import open_bounces


@dataclass
class Plan:
    """A resolved study and its cells to do.

    Attributes:
        study, scenes, cells: study, scenes and cells of a complete run.
        todo: cells without a record.
        other_code: number of records computed by different code.
        notices: notices to the user, by scene; scenes without any are left out.
    """

    study: Study
    scenes: dict[str, Scene]
    cells: list[Cell]
    todo: list[Cell]
    other_code: int = 0
    notices: dict[str, list[str]] = field(default_factory=dict)

    @property
    def reused(self) -> int:
        """Number of cells that an earlier run finished."""
        return len(self.cells) - len(self.todo)


@dataclass
class Summary:
    """Outcome of a run."""

    expected: int
    reused: int
    computed: int = 0
    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def complete(self) -> bool:
        """True if every expected cell has a record."""
        return not self.failures and self.reused + self.computed == self.expected


def plan(study: Study, store: Store) -> Plan:
    """Load the scenes, list the cells, and find those that ``store`` already has.

    Raises:
        InputError: something that the study names cannot be used, or is in none of its scenes.
    """
    silence_notices()  # the plan collects them below
    scenes = _scenes(study)
    cells = cells_of(study, scenes)
    _check_names(study, list(scenes.values()), cells)
    named = dict(zip(study.scene_names, scenes.values(), strict=True))
    check_keys(study, named, cells)
    done = store.done()
    load_plugins()  # plugins' source is part of the code
    this = Environment.from_json(environment())
    todo: list[Cell] = []
    other_code = 0
    for cell in cells:
        record = store.whole(cell.id, probe(cell.probe).read) if cell.id in done else None
        # Pictures are not part of a cell's id: the study may now save other pictures.
        if record is None or not set(cell.pictures) <= {p.view for p in record.pictures}:
            todo.append(cell)
        else:
            other_code += not record.environment.same_code(this)
    said = {
        name: lines
        for name, scene in named.items()
        if (lines := [*notices(scene), *open_bounces(scene)])
    }
    return Plan(study, named, cells, todo, other_code, said)


def _scenes(study: Study) -> dict[str, Scene]:
    scenes: dict[str, Scene] = {}
    for name in scene_files(study):
        scenes[name] = load_scene(name)
        for other, scene in scenes.items():
            if other != name and scene.content_hash == scenes[name].content_hash:
                raise StudyError(f"scenes: {other!r} and {name!r} are the same scene; name it once")
    return scenes


def _check_names(study: Study, scenes: list[Scene], cells: list[Cell]) -> None:
    """Check that views to be pictured, and names in probes, are of some scene of the study.

    A misspelt name would otherwise change the study silently. A name found in no chosen scene may
    be of a scene left out; only then are those scenes loaded.

    Raises:
        StudyError: a name is in no scene.
    """
    # Fits measure held-out views.
    own = {view for cell in cells for view in cell.spec.get("views", ())}

    def check(scenes: list[Scene]) -> None:
        views = own | {camera.name for scene in scenes for camera in scene.targets}
        for name in study.pictures.views:
            if name not in views:
                raise StudyError(
                    f"pictures.views: no scene has a view {name!r}"
                    f"{did_you_mean(name, sorted(views))}"
                )
        for each in probes():
            each.check_scenes(study, scenes)

    try:
        check(scenes)
    except StudyError:
        if not study.left_out:
            raise
        check([*scenes, *map(load_scene, study.left_out)])


def verify(store: Store) -> Problems:
    """Recompute the hashes of a run's cells and pictures, and list its expected cells again from
    its study.

    Raises:
        InputError: the folder is not a run.
    """
    silence_notices()
    stored = store.read_study()
    _check_plugins(store, stored)
    problems = store.verify()
    try:
        study = parse_study(stored["study"])
        cells = [_entry(cell) for cell in cells_of(study, _scenes(study))]
    except (InputError, ValidationError) as error:
        text = explain_errors(error) if isinstance(error, ValidationError) else error
        problems.damaged.append(f"the study's cells cannot be listed again: {text}")
        return problems
    if {c["id"] for c in stored["cells"]} != {c["id"] for c in cells}:
        problems.damaged.append(
            "the study names other cells today: a scene or a protocol has changed since; run it"
            " again for the new ones"
        )
    return problems


@dataclass(frozen=True)
class Stored:
    """Contents of ``study.json`` of a run."""

    study: Study
    cells: list[dict[str, Any]]
    notices: dict[str, list[str]]


def stored_study(store: Store) -> Stored:
    """Read a run's study and its expected cells from ``study.json``.

    Raises:
        StoreError: the folder is not a run, or its study cannot be read.

    Example:
        >>> from attnwarp_eval.study.run import expected, plan, stored_study
        >>> content = dict(name="my", scenes=["spheres"], variants={"a": {}})
        >>> study = parse_study(content | {"probes": {"depth": ["a"]}})
        >>> store = Store("run")
        >>> store.write_study(expected(plan(study, store)))
        >>> [cell["title"] for cell in stored_study(store).cells]
        ['spheres / calibration / calibration', 'spheres / a / depth']
    """
    stored = store.read_study()
    _check_plugins(store, stored)
    path = store.root / "study.json"
    remedy = f"run the study again with --out {store.root}, which writes it anew"
    try:
        study = parse_study(stored["study"])
    except ValidationError as error:
        raise StoreError(f"{path}: {explain_errors(error)}; {remedy}") from None
    needs_scenes = {p.name: p.needs_scenes for p in probes()}
    for cell in stored["cells"]:
        on_scene = needs_scenes.get(cell["probe"], True)
        if cell["probe"] not in needs_scenes or (
            on_scene and cell["scene"] not in study.scene_names
        ):
            raise StoreError(
                f"{path}: cell {cell['title']!r} names a probe or a scene that the study lacks;"
                f" {remedy}"
            )
    scenes = stored.get("scenes", {}).items()
    said = {name: entry["notices"] for name, entry in scenes if entry.get("notices")}
    return Stored(study, stored["cells"], said)


def _check_plugins(store: Store, stored: dict[str, Any]) -> None:
    """Import the plugins; report the run's missing plugins before anything else fails.

    Raises:
        StoreError: plugins of the run are missing, and the study cannot be read without them.
        InputError: a plugin cannot be imported.
    """
    load_plugins()
    missing = sorted(set(stored.get("plugins", ())) - set(plugin_modules()))
    if not missing:
        return
    try:
        parse_study(stored["study"])
        known = {each.name for each in probes()}
        readable = all(cell["probe"] in known for cell in stored["cells"])
    except (InputError, ValidationError):
        readable = False
    if not readable:
        raise StoreError(
            f"{store.root}: was made with the plugins {', '.join(missing)}, which are not named"
            f" here; install their packages, or set {VARIABLE}={','.join(missing)}"
        )


def expected(plan: Plan) -> dict[str, Any]:
    """Content of ``study.json``: the resolved study and the cells of a complete run."""
    return {
        "study": plan.study.model_dump(mode="json"),
        "scenes": {
            name: {
                "hash": scene.content_hash,
                "title": scene.title,
                **({"notices": plan.notices[name]} if name in plan.notices else {}),
            }
            for name, scene in plan.scenes.items()
        },
        **({"plugins": modules} if (modules := plugin_modules()) else {}),
        "cells": [_entry(cell) for cell in plan.cells],
    }


def _entry(cell: Cell) -> dict[str, Any]:
    """A cell as ``study.json`` lists it."""
    return {
        "id": cell.id,
        "title": cell.title,
        "scene": cell.scene,
        "variants": list(cell.labels),
        "probe": cell.probe,
        "seed": cell.seed,
    }


def execute(
    plan: Plan,
    store: Store,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    keep_going: bool = True,
    report: Reporter = SILENT,
) -> Summary:
    """Compute the cells to do, and write each as soon as it is finished.

    Args:
        jobs: worker processes, at most one for each cell and core; 1 computes in this process. The
            figures do not depend on it.
        scheduler: address or file of a dask scheduler, whose workers compute the cells.
        keep_going: whether to continue after a failed cell.
        report: callback for each beginning and end of a cell, and lines on failures and workers.

    Raises:
        ClusterError: the scheduler cannot be reached, or every worker is refused.
        ClusterLost: the connection to the scheduler broke; finished cells are stored.
    """
    start = time.perf_counter()
    store.write_study(expected(plan))
    cells = CellReporter(len(plan.todo), plan.reused, report)
    failures = compute_cells(
        plan.todo, store, cells, jobs=min(jobs, core_count()), scheduler=scheduler,
        scenes=plan.scenes, keep_going=keep_going,
    )  # fmt: skip
    computed = cells.done - plan.reused - len(failures)
    seconds = time.perf_counter() - start
    return Summary(len(plan.cells), plan.reused, computed, failures, seconds)


def compute_cells(
    cells: list[Cell],
    store: Store,
    report: CellReporter,
    *,
    jobs: int,
    scheduler: str | None,
    scenes: Mapping[str, Scene],
    needs: Sequence[Path] = (),
    keep_going: bool = True,
) -> list[Failure]:
    """Compute cells, in this process or on workers, and return the failures; see :func:`execute`.

    Workers of a scheduler must be able to read the paths of ``needs``.
    """
    jobs = min(jobs, len(cells))
    if scheduler is not None:
        work = run_on_scheduler(cells, store, scenes, scheduler, report, needs)
    elif jobs > 1:
        work = run_on_workers(cells, store.root, jobs, report)
    else:
        work = _in_this_process(cells, store, report)
    failures = []
    # Close at once: an interrupt must end the workers before the command ends.
    with contextlib.closing(work):
        for cell, failure in work:
            if failure is not None:
                store.write_failure(cell.id, asdict(failure))
                failures.append(failure)
            report.end(cell, failure)
            if failure is not None and not keep_going:
                break
    return failures


def _in_this_process(
    cells: list[Cell], store: Store, report: CellReporter
) -> Generator[tuple[Cell, Failure | None]]:
    for cell in cells:
        report.start(cell)
        yield cell, compute_and_write(probe(cell.probe), cell, str(store.root))
