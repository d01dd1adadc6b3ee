"""Definition of a probe: the interface that studies, the runner and the store use; and the probes
by name.

Reports of probes are defined in :mod:`attnwarp_eval.study.probe_report`.

>>> [probe.name for probe in probes()]
['calibration', 'carry', 'depth', 'editing', 'fit', 'ideal', 'labels', 'masks', 'shape',
 'stability', 'timing', 'warp']
>>> probe("depth").metric("depth.abs_rel").direction
'lower'
"""

from __future__ import annotations

import hashlib
import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from attnwarp_eval.cost import Meter
from attnwarp_eval.files import write_atomic
from attnwarp_eval.metrics.registry import METRICS, Metric, Registry
from attnwarp_eval.plugins import load_plugins
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.record import Extra, Json, NoExtra, PictureFile, Record, View
from attnwarp_eval.study.results import Outcome
from attnwarp_eval.study.schema import Part, Study, Variant
from attnwarp_eval.world import World

E = TypeVar("E", bound=Extra)
K = TypeVar("K", bound="type[Probe[Any]]")

PROBES = "attnwarp_eval.study.probes"
"""Package of the bundled probes."""


@dataclass(frozen=True)
class InTurn:
    """Seconds of contestants that ran in turn in one process.

    Attributes:
        names: names of the contestants; the first is the baseline.
        seconds: stage -> contestant -> round; the baseline's second run comes last.
        of: description of each contestant's task.
        scene: name of the scene.
    """

    names: tuple[str, ...]
    seconds: Mapping[str, list[list[float]]]
    rounds: int
    threads: int
    of: str
    scene: str = ""


@dataclass
class Work:
    """State of a cell during computation: a probe's inputs, and its results.

    Attributes:
        root: the run's folder.
        scene_world: world of the scene at the study's size; None for a probe that needs no
            scenes.
        views, pictures: results so far.
    """

    cell: Cell
    root: Path
    scene_world: World | None
    meter: Meter
    views: list[View] = field(default_factory=list)
    pictures: list[PictureFile] = field(default_factory=list)

    @property
    def world(self) -> World:
        """World of the scene. LookupError: the probe has no scene."""
        if self.scene_world is None:
            raise LookupError(f"probe {self.cell.probe!r} needs no scenes, so it has no world")
        return self.scene_world

    @property
    def spec(self) -> Json:
        """Spec of the cell."""
        return self.cell.spec

    def add(
        self,
        view: str,
        metrics: Mapping[str, float],
        draw: Callable[[], Mapping[str, bytes]] | None = None,
    ) -> None:
        """Add the figures of a view, and its pictures if the study saves them.

        Args:
            view: name of the target, or ``task/target``, where the task may be an edit.
            metrics: figures by name; NaN or infinite where undefined.
            draw: function that returns JPEG files by content.
        """
        yaw = self.world.yaw[view.rpartition("/")[2]]
        self.views.append(View(view, yaw, dict(metrics)))
        if draw is not None:
            self.draw(view, draw)

    def draw(self, view: str, draw: Callable[[], Mapping[str, bytes]]) -> None:
        """Save the pictures of a view, or of the source, as :meth:`add` does."""
        if view not in self.cell.pictures:
            return
        with self.meter.stage("pictures"):
            for content, data in draw().items():
                path = Path("pictures") / self.cell.id[:16] / f"{view}-{content}.jpg"
                write_atomic(self.root / path, data)
                sha256 = hashlib.sha256(data).hexdigest()
                self.pictures.append(PictureFile(view, content, str(path), sha256))


class Probe(ABC, Generic[E]):
    """Kind of measurement, from a study's YAML to its records.

    A probe is a class that :func:`register` decorates: in a module of :data:`PROBES`, in
    ``measure.py`` of a folder there, or in a module of a plugin. No other code names it. A
    :class:`~attnwarp_eval.study.probe_report.ProbeReport` makes its tables.

    Attributes:
        name: name in a study's ``probes`` and in every record.
        protocol: version; raised when the figures change meaning, which gives all cells new ids.
        study_part: keys of a study's YAML that only this probe reads.
        variant_part: keys of a variant that only this probe reads.
        metrics: specification of every figure of its records.
        needs_scenes: whether its cells have scenes; else ``cells`` names other subjects.
        judges_variants: whether it has cells for each variant.
        always: whether every run has its cells, even if the study does not list it.
        times_in_turn: stages of :class:`InTurn` that its records may have.
        edits: whether it measures editing methods, which have separate presets.
    """

    name: ClassVar[str]
    protocol: ClassVar[int] = 1
    study_part: ClassVar[type[Part] | None] = None
    variant_part: ClassVar[type[Part] | None] = None
    metrics: ClassVar[Registry] = Registry({})
    needs_scenes: ClassVar[bool] = True
    judges_variants: ClassVar[bool] = True
    always: ClassVar[bool] = False
    times_in_turn: ClassVar[Sequence[str]] = ()
    edits: ClassVar[bool] = False

    @property
    def tabled(self) -> bool:
        """True if its figures allow a table of variants."""
        return self.judges_variants and bool(self.metrics)

    # From a study to cells

    def check(self, study: Study) -> None:
        """Raise ValueError if this probe cannot measure the study.

        Called for every study, with or without this probe; the message begins with the YAML's key.
        """

    def check_scenes(self, study: Study, scenes: Sequence[Scene]) -> None:
        """Raise StudyError if the study names something that none of its scenes has.

        Called before a run of any study, with or without this probe.
        """

    def check_variant(self, study: Study, variant: Variant) -> None:
        """Raise ValueError if a variant cannot be measured; the caller prepends its name."""

    def measured(self, study: Study) -> Set[str]:
        """Variants of a study on which cells of this probe depend."""
        return set(study.probes.get(self.name, ()))

    def cells(
        self, study: Study, names: Sequence[str], scenes: Mapping[str, Scene]
    ) -> Iterator[Cell]:
        """Cells of a study: by default, one for each scene, variant and seed.

        Args:
            names: names of the study's variants for this probe.
            scenes: scenes by their names in the study.

        Raises:
            StudyError: the study does not fit a scene.
        """
        for name, scene in scenes.items():
            for label in names:
                variant = study.variants[label]
                for seed in study.seeds:
                    spec = {
                        **self.common_spec(study, scene, seed),
                        **self.variant_spec(study, variant, seed),
                    }
                    pictures = study.pictures_of(spec["views"], label)
                    yield Cell(spec, name, label, self.name, seed, (label,), pictures)

    def common_spec(self, study: Study, scene: Scene, seed: int) -> Json:
        """Entries in the spec of every cell of this probe."""
        return {
            "probe": self.name,
            "protocol": self.protocol,
            "scene": scene.content_hash,
            "size": study.size,
            "views": study.views_of(scene),
            "seed": seed,
        }

    def variant_spec(self, study: Study, variant: Variant, seed: int) -> Json:
        """Entries of a study and a variant that decide the figures of this probe, and no others:
        two variants that differ elsewhere share a cell.
        """
        return {}

    def meaning(self, study: Study, variant: Variant) -> tuple[Any, ...]:
        """Key that two variants share if they mean the same to a claim about this probe."""
        return variant.settings(), variant.geometry, study.splats_of(variant)

    # From a cell to its record

    @abstractmethod
    def compute(self, work: Work) -> E:
        """Compute a cell: figures and pictures go to ``work.add``, the rest is returned."""

    def read_extra(self, data: Json) -> E:
        """Read the extra of a record from the record's JSON."""
        return NoExtra()  # type: ignore[return-value]

    def read(self, data: Json) -> Record[E]:
        """Read a record of this probe from its JSON."""
        return Record.from_json(data, self.read_extra(data))

    def metric(self, key: str) -> Metric:
        """Specification of a figure. KeyError: this probe has no such figure."""
        return self.metrics[key]

    def in_turn(self, cell: Outcome, record: Record[E]) -> InTurn | None:
        """Seconds of contestants, if this probe times them."""
        return None


def metrics_of(*prefixes: str) -> Registry:
    """The registered metrics whose names begin with one of the prefixes."""
    return Registry({k: m for k, m in METRICS.items() if k.startswith(prefixes)})


_registered: dict[str, Probe[Any]] = {}


def register(kind: K) -> K:
    """Class decorator: make a probe available under its name.

    Raises:
        ValueError: another class has that name.
    """
    other = _registered.get(kind.name)
    if other is not None and type(other) is not kind:
        raise ValueError(f"probe {kind.name!r}: {type(other).__qualname__} has that name already")
    _registered[kind.name] = kind()
    return kind


def unregister(name: str) -> None:
    """Take back :func:`register`."""
    _registered.pop(name, None)


def import_probes(package: str) -> None:
    """Import the modules of a package of probes; of a folder, its ``measure.py``."""
    folder = importlib.import_module(package).__path__
    for module in sorted(pkgutil.iter_modules(folder), key=lambda module: module.name):
        importlib.import_module(f"{package}.{module.name}{'.measure' if module.ispkg else ''}")


@cache
def _discover() -> None:
    import_probes(PROBES)
    load_plugins()


def probes() -> list[Probe[Any]]:
    """Every probe, by name."""
    _discover()
    return [_registered[name] for name in sorted(_registered)]


def probe(name: str) -> Probe[Any]:
    """Look up a probe by name. KeyError: no such probe."""
    _discover()
    return _registered[name]
