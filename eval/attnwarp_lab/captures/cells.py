"""Cells of a run on captures: fits, edits with their figures, and warps of the source.

A cell is one capture x edit x variant x seed. Its id is the hash of its inputs. Its files are in
the run's folder, so workers must be able to read that folder and the manifest's.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from attnwarp.editing.small import dtype_of, guide_of, load_editor, own_steps_of, thread_count
from attnwarp.encoders import Kind, load_encoder
from attnwarp.errors import InputError
from attnwarp.fit.views import to_float
from attnwarp.gaussians import Gaussians
from attnwarp.methods import METHODS, Budget
from attnwarp.methods.base import workdir_of
from attnwarp.methods.page import PAGE, show_edit
from attnwarp.methods.pictures import enlarged_change, to_bytes
from attnwarp.methods.scene import near_of, render_picture
from attnwarp.reporting import SILENT, Reporter
from attnwarp.workdir import MANIFEST
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.files import write_picture
from attnwarp_eval.study.cell import Cell, merged
from attnwarp_eval.study.probe import Probe, Work, register, unregister
from attnwarp_eval.study.record import Failure, Json, with_nan
from attnwarp_eval.study.shared import editing_methods
from attnwarp_eval.study.shared.editing_methods import (
    EDITING_METHODS,
    EditedScene,
    needs_source_words,
    with_source_words,
)
from attnwarp_eval.study.store import Store
from attnwarp_eval.user_images import measure
from attnwarp_lab.captures.capture import (
    FITS,
    MADE,
    MARKS,
    ORIGINALS,
    Ready,
    check_likeness,
    read_splats,
    ready,
    segments,
    splats_file,
)
from attnwarp_lab.captures.check import Checked
from attnwarp_lab.captures.manifest import Loaded, Manifest, Row

PROTOCOL = 1
"""Version; raised when the same inputs would give other figures."""

COUNTED = ("network_rows", "edits", "iterations", "splats", "feature_bytes")
"""Counters of a method kept in records."""

AUTHORS = {"clip": "clip-whole", "dinov2": "dinov2-518"}
"""Encoders with the preprocessing of the paper's authors, by the published encoder."""


@dataclass(frozen=True)
class Made:
    """Result of a cell besides its record's usual entries.

    Attributes:
        figures: figures by title, with the encoders' published preprocessing.
        authors: figures by title, with the preprocessing of the paper's authors.
        counts: counts of views, edited views, network rows, iterations and splats.
        cut: the limit of the budget that ended the method; None for a whole run.
        page: path of the method's page in the run's folder; None for a method without one.
        seconds: seconds of the method, by part.
        gpu: peak GiB of a GPU; NaN without one.
        files: paths in the run's folder, with SHA-256.
    """

    figures: Mapping[str, float] = field(default_factory=dict)
    authors: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, float] = field(default_factory=dict)
    cut: str | None = None
    page: str | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    gpu: float = np.nan
    files: Sequence[Mapping[str, str]] = ()

    def to_json(self) -> Json:
        """Entries of a record; seconds and bytes are entries of its cost."""
        data = asdict(self)
        cost = {"method": data.pop("seconds"), "gpu_gib": data.pop("gpu")}
        return {**without_nan(data), "cost": without_nan(cost)}

    @classmethod
    def from_json(cls, data: Json) -> Made:
        """Rebuild from :meth:`to_json`."""
        cost = with_nan({"gpu": data["cost"]["gpu_gib"]})
        figures, authors, counts = (with_nan(data[key]) for key in ("figures", "authors", "counts"))
        return cls(
            figures, authors, counts,
            data["cut"], data["page"], data["cost"]["method"], cost["gpu"], data["files"],
        )  # fmt: skip


class Captured(Probe[Made]):
    """Probe of captures; no study names it, so it is registered during a run."""

    name: ClassVar[str] = "captures"
    protocol: ClassVar[int] = PROTOCOL
    needs_scenes: ClassVar[bool] = False
    judges_variants: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def compute(self, work: Work) -> Made:
        """Fit, edit or warp, by the cell's spec."""
        s = work.cell.sources
        loaded = Loaded(Manifest.model_validate_json(s["manifest"]), Path(s["folder"]))
        job = Job(loaded, Path(s["run"]), _own_device(s["devices"].split(",")), work.cell)
        return {"fit": job.fit, "edit": job.edit, "warp": job.warp}[work.spec["kind"]]()

    def read_extra(self, data: Json) -> Made:
        """The extra of a record."""
        return Made.from_json(data)


def _own_device(devices: Sequence[str]) -> str:
    """The device of this process, assigned by the worker's number in turn."""
    if "distributed" not in sys.modules:  # the command's process, which needs no dask
        return devices[0]
    from distributed import get_worker

    try:
        number = str(get_worker().name)
    except ValueError:  # not a worker
        number = "0"
    return devices[int(number) % len(devices) if number.isdecimal() else 0]


@lru_cache(maxsize=1)
def editor_of(name: str, device: str) -> Any:
    """Load an editor; each process caches the last one."""
    return load_editor(name, device=device, dtype=dtype_of("auto", device, name))


@cache
def encoder_of(name: str, kind: Kind, *, device: str) -> Any:
    """Load an encoder, cached per process: cells are tuned and measured with the same few."""
    return load_encoder(name, kind, device=device)


@dataclass(frozen=True)
class Job:
    """A running cell.

    Attributes:
        loaded, cell: the manifest and the cell.
        run: the run's folder.
        device: "cpu" or "cuda", with a number or without.
        report: callback for progress.
        budget: limits of the method; None for a whole cell.
        first_splats: whether to use a fit's initial splats if the fit has not ended.
    """

    loaded: Loaded
    run: Path
    device: str
    cell: Cell
    report: Reporter = SILENT
    budget: Budget | None = None
    first_splats: bool = False

    @property
    def capture(self) -> Ready:
        """Capture of the cell."""
        return ready(self.loaded, self.cell.scene)

    def folder(self) -> Path:
        """Folder of the cell's files."""
        return cell_folder(self.run, self.cell.id)

    def _files(self, *folders: Path) -> list[dict[str, str]]:
        paths = sorted(p for f in folders for p in ([f] if f.is_file() else f.rglob("*")))
        return [Store(self.run).keep_picture(p) for p in paths if p.suffix in (".png", ".ply")]

    def fit(self) -> Made:
        """Fit splats to all views; an interrupted fit is resumed."""
        from attnwarp.fit import FitSettings, first_splats, fit

        capture, kind = self.capture, self.cell.spec["settings"]["kind"]
        settings = FitSettings.from_dict(self.cell.spec["settings"])
        path = splats_file(self.loaded, self.run, self.cell.scene, kind)
        path.parent.mkdir(parents=True, exist_ok=True)
        start = first_splats(capture.dataset, capture.cameras, settings, self.report)
        done = fit(start.to(device=self.device), capture.views, settings, folder=path.parent)
        place = f"captures.{self.cell.scene}: fit of {kind}gs"
        check_likeness(place, path, capture, done.gaussians.to(device="cpu"))
        counts = {"splats": len(done.gaussians), "iterations": done.iteration}
        return Made(
            counts=counts, seconds={"fit": done.seconds}, gpu=_gpu(self.device),
            files=self._files(path),
        )  # fmt: skip

    def edit(self) -> Made:
        """Edit a capture by a variant's method, and measure the result."""
        capture, folder = self.capture, self.folder()
        _reset_gpu(self.device)
        result, before = self.run_method()
        originals = self.run / ORIGINALS / self.cell.scene
        images = [capture.views.picture(k) for k in range(len(capture.views))]
        near = near_of(capture.cameras, before)
        for k, camera in enumerate(capture.cameras):
            _write(originals, k, images[k])
            _write(folder / "renders", k, render_picture(result.gaussians, camera, near, "auto"))
        for k, pixels in result.edited.items():
            _write(folder / "edited", k, enlarged_change(images[k], to_float(pixels)))
        page = None
        method = workdir_of(folder / "run")
        if method.has(MANIFEST):  # an external method leaves no such folder
            page = (method.path / PAGE).relative_to(self.run).as_posix()
            if not method.has(PAGE):
                show_edit(method, before, capture.views)
        counts = {
            "views": len(capture.cameras), "edited": len(result.edited),
            **{k: result.counters[k] for k in COUNTED if k in result.counters},
        }  # fmt: skip
        edited = (folder / "renders", folder / "edited", folder / "run" / "edited.ply", originals)
        return Made(
            self.figures(result, originals), self.figures(result, originals, authors=True), counts,
            result.cut, page, result.seconds, _gpu(self.device), self._files(*edited),
        )  # fmt: skip

    def run_method(self) -> tuple[EditedScene, Gaussians]:
        """The result of the cell's method, and the splats before it."""
        from attnwarp.fit import compile_kernels

        spec, capture, row = self.cell.spec, self.capture, self.row
        editor = editor_of(self.loaded.editor(row.editor), self.device)
        torch.set_num_threads(thread_count(editor))
        splats = self.splats(row.splats)
        compile_kernels(splats.kind, self.report, self.device)
        marked = segments(self.loaded, self.cell.scene, self.run, self.device, self.report)
        job = editing_methods.Job(
            splats, capture.cameras, capture.views.images, editor, spec["text"], spec["settings"],
            self.folder() / "run", None, {}, self.budget or Budget.from_dict(row.budget),
            segments=marked(splats), source=capture.source, masks=capture.views.masks,
            report=self.report, load=encoder_of,
        )  # fmt: skip
        return EDITING_METHODS[spec["method"]].run(job), splats

    @property
    def row(self) -> Row:
        """Variant of the cell."""
        return self.loaded.manifest.variants[self.cell.variant]

    def splats(self, kind: str) -> Gaussians:
        """Splats of the capture, on the device."""
        path = splats_file(self.loaded, self.run, self.cell.scene, kind)
        if self.first_splats and not path.is_file():
            from attnwarp.fit import FitSettings, first_splats

            settings = FitSettings.from_dict({**self.loaded.manifest.fit, "kind": kind})
            start = first_splats(self.capture.dataset, self.capture.cameras, settings)
            return start.to(device=self.device)
        return read_splats(path, kind).to(device=self.device)

    def figures(
        self, result: EditedScene, originals: Path, authors: bool = False
    ) -> dict[str, float]:
        """Figures by title; bundled encoders have no version of the authors."""
        folder, words = self.folder(), self.cell.spec["words"]
        source = folder / "edited" / picture_name(self.capture.source)
        kinds: tuple[Kind, ...] = ("clip", "dino", "perceptual")
        names: dict[Kind, str | None] = {kind: self.loaded.encoder(kind) for kind in kinds}
        if authors:
            names = {k: authors_version(str(name)) or measure.OFF for k, name in names.items()}
            if set(names.values()) == {measure.OFF}:
                return {}
        inputs = measure.Inputs(
            folder / "renders", folder / "edited" if result.edited else None, originals,
            source if self.capture.source in result.edited else None,
            words["target"], words["source"],
        )  # fmt: skip
        done = measure.measure(
            inputs, names, Store(folder / "measured"), device=self.device, load=encoder_of
        )
        return {row.title: row.value for row in done.rows if row.encoder or not authors}

    def warp(self) -> Made:
        """The source's picture warped into a target by both kinds of splats, with its mask."""
        from attnwarp.warp import PRESETS, warp_view
        from attnwarp_eval.study.shared.pictures import carried

        capture, folder, target = self.capture, self.folder(), self.cell.spec["target"]
        source = capture.views.picture(capture.source)
        truth = capture.views.picture(target)
        figures: dict[str, float] = {}
        for kind in ("2d", "3d"):
            splats = self.splats(kind)
            view = warp_view(
                splats, capture.cameras[capture.source], capture.cameras[target],
                PRESETS["paper"], near=near_of(capture.cameras, splats), warn_empty=False,
            )  # fmt: skip
            warped = carried(source, view)
            mask = view.mask.cpu().numpy()
            figures[f"valid, {kind}gs"] = float(mask.mean())
            apart = np.abs(warped - truth)[mask]
            figures[f"apart, {kind}gs"] = float(apart.mean()) if apart.size else np.nan
            shown = np.where(mask[..., None], warped, 0.0)
            for what, picture in (("warped", warped), ("valid", shown)):
                _write(folder, f"{what}-{kind}", picture)
        for what, picture in (("source", source), ("target", truth)):
            _write(folder, what, picture)
        return Made(figures, files=self._files(folder))


def picture_name(view: int) -> str:
    """File name of a view's picture."""
    return f"view-{view:04d}.png"


def _write(folder: Path, what: int | str, picture: Any) -> None:
    name = picture_name(what) if isinstance(what, int) else f"{what}.png"
    write_picture(folder / name, to_bytes(picture))


def cell_folder(run: Path, cell_id: str) -> Path:
    """Folder of a cell's files."""
    return run / MADE / cell_id[:16]


def rests_on(cell: Cell, name: str) -> bool:
    """Return True if a cell wrote or reads a file.

    Args:
        cell: a cell of the run.
        name: path of the file in the run's folder.
    """
    part, place, *_ = (*name.split("/"), "")
    of_scene = part in (ORIGINALS, FITS, MARKS) and cell.scene in (place, place.rpartition("-")[0])
    return of_scene or cell.id[:16] in name


def _reset_gpu(device: str) -> None:
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats(device)


def _gpu(device: str) -> float:
    return np.nan if device == "cpu" else torch.cuda.max_memory_allocated(device) / 2**30


def authors_version(name: str) -> str | None:
    """The encoder with the authors' preprocessing; None if there is none.

    Example:
        >>> authors_version("clip:/models/clip"), authors_version("clip-small")
        ('clip-whole:/models/clip', None)
    """
    scheme, colon, place = name.partition(":")
    return f"{AUTHORS[scheme]}:{place}" if colon and scheme in AUTHORS else None


@dataclass(frozen=True)
class Planned:
    """Cells of a manifest in running order: all cells of a wave may run at once; and notes on
    omitted and unequal cells."""

    loaded: Loaded
    checked: Checked
    fits: list[Cell]
    edits: list[Cell]
    warps: list[Cell]
    notes: list[str]

    @property
    def waves(self) -> tuple[list[Cell], list[Cell]]:
        """Fits, then the cells that need them."""
        return self.fits, [*self.edits, *self.warps]

    @property
    def cells(self) -> list[Cell]:
        """All cells."""
        return [*self.fits, *self.edits, *self.warps]


def plan(loaded: Loaded, checked: Checked, run: Path, devices: Sequence[str]) -> Planned:
    """Plan the cells of a manifest with checked inputs."""
    m = loaded.manifest
    sources = {
        "manifest": m.model_dump_json(), "folder": str(loaded.folder.resolve()),
        "run": str(run.resolve()), "devices": ",".join(devices),
    }  # fmt: skip

    def cell(kind: str, scene: str, variant: str, seed: int, **spec: Any) -> Cell:
        common = {
            "probe": Captured.name, "protocol": PROTOCOL, "kind": kind,
            "capture": checked.captures[scene], "seed": seed,
        }  # fmt: skip
        return Cell({**common, **spec}, scene, variant, Captured.name, seed, (variant,), (),
                    sources)  # fmt: skip

    kinds = {row.splats for row in m.variants.values()} | ({"2d", "3d"} if m.geometry else set())
    fits = [
        cell("fit", name, f"fit of {kind}gs", 0, settings=_fit_settings(m, kind))
        for name, capture in m.captures.items()
        for kind in sorted(kinds - capture.splats.keys())
    ]

    def splats_of(name: str, kind: str) -> Any:
        return checked.splats[name].get(kind) or {"fit": _fit_settings(m, kind)}

    def edit(name: str, edit_name: str, variant: str, row: Row, seed: int) -> Cell:
        words = m.captures[name].edits[edit_name]
        return cell(
            "edit", name, variant, seed,
            edit=edit_name,
            splats=splats_of(name, row.splats),
            mask=checked.masks.get(name),
            method=row.method,
            settings=with_source_words(settings[variant, seed], words.source or ""),
            budget=row.budget,
            text=words.text(guide_of(loaded.editor(row.editor))),
            words={"source": words.source, "target": words.target},
            editor=checked.weights[f"editors.{row.editor}"][0],
            encoders={k: v for k, (v, _) in checked.weights.items() if k.startswith("encoders.")},
        )  # fmt: skip

    settings = {
        (name, seed): settings_of(loaded, row, seed, checked.sizes[row.editor])
        for name, row in m.variants.items()
        for seed in loaded.seeds(row)
    }
    edits, notes = [], _unequal(loaded, checked, settings)
    for name, edit_name in loaded.edits():
        for variant, row in m.variants.items():
            seeds = loaded.seeds(row)
            told = m.captures[name].edits[edit_name].source is not None
            if needs_source_words(settings[variant, seeds[0]]) and not told:
                notes.append(
                    f"left out: {name} / {edit_name} / {variant}: it inverts with the words for the"
                    " scene before, which the edit lacks; give `source` (--source-prompt)"
                )
                continue
            edits += [edit(name, edit_name, variant, row, seed) for seed in seeds]
    if not edits:
        raise InputError("; ".join(notes))
    warps = [
        cell("warp", name, f"view {target}", 0, target=target,
             splats=[splats_of(name, kind) for kind in ("2d", "3d")])
        for name in m.captures
        for target in _targets(len(checked.views[name]), ready(loaded, name).source, m.geometry)
    ]  # fmt: skip
    return Planned(loaded, checked, fits, merged(edits), warps, notes)


def _fit_settings(manifest: Manifest, kind: str) -> Json:
    from attnwarp.fit import FitSettings

    return FitSettings.from_dict({**manifest.fit, "kind": kind}).to_dict()


def settings_of(loaded: Loaded, row: Row, seed: int, size: int) -> Json:
    """All settings of a row's method; the library's use the manifest's size and encoder, and the
    editor's own steps.
    """
    own = dict(row.options)
    if row.method in METHODS:
        with suppress(InputError):  # a missing editor is named by the checks
            own.setdefault("steps", own_steps_of(loaded.editor(row.editor)))
        own |= {"size": size, "perceptual_encoder": loaded.encoder("perceptual")}
    return EDITING_METHODS[row.method].settings(row.preset, own, seed)


def _unequal(loaded: Loaded, checked: Checked, settings: Mapping[Any, Json]) -> list[str]:
    """A note where variants edit different numbers of a capture's views, and the remedy."""
    name, views = next(iter(checked.views.items()))
    counts = {
        variant: edited(settings[variant, loaded.seeds(row)[0]], len(views))
        for variant, row in loaded.manifest.variants.items()
        if (edited := EDITING_METHODS[row.method].edited) is not None
    }
    if len(set(counts.values())) < 2:
        return []
    listed = ", ".join(f"{variant} {count}" for variant, count in counts.items())
    return [
        f"of {len(views)} views of {name}, variants edit {listed}; Edit PSNR is of edited views"
        " alone, and more edits cost more: options views_per_stage of attention_warping, and views"
        " of methods that draw them, make the numbers equal"
    ]


def _targets(views: int, source: int, count: int) -> list[int]:
    """Views evenly spread after the source, without it."""
    return sorted(
        {(source + (k + 1) * views // (count + 1)) % views for k in range(count)} - {source}
    )


def todo(cells: Sequence[Cell], store: Store) -> list[Cell]:
    """Cells without a whole record and whole files."""
    done = store.done()

    def whole(cell: Cell) -> bool:
        read = Captured().read
        record = store.whole(cell.id, read) if cell.id in done else None
        return record is not None and not store.damaged_pictures(record.extra.files)

    return [cell for cell in cells if not whole(cell)]


def execute(
    planned: Planned, store: Store, *, jobs: int, scheduler: str | None, report: Reporter
) -> list[Failure]:
    """Compute the cells to do, fits first, and return the failures.

    Args:
        jobs: worker processes; 1 computes in this process.
        scheduler: a dask scheduler whose workers can read the run's folder and the manifest's.
    """
    from attnwarp_eval.study.reporting import CellReporter
    from attnwarp_eval.study.run import compute_cells

    failures: list[Failure] = []
    needs = [store.root / "study.json", *planned.loaded.paths()]
    register(Captured)
    try:
        for wave in planned.waves:
            left = todo(wave, store)
            cells = CellReporter(left, len(wave) - len(left), report)
            failures = compute_cells(
                left, store, cells, jobs=jobs, scheduler=scheduler, scenes={}, needs=needs
            )
            if failures:
                break
    finally:
        unregister(Captured.name)
    return failures


def made_of(planned: Planned, store: Store) -> Iterator[tuple[Cell, Any]]:
    """Finished cells with their records."""
    for cell in planned.cells:
        record = store.whole(cell.id, Captured().read)
        if record is not None:
            yield cell, record


def expected(planned: Planned) -> Json:
    """Content of the run's ``study.json``: the manifest, its inputs and its cells."""
    c = planned.checked
    return {
        "manifest": planned.loaded.manifest.model_dump(mode="json"),
        "inputs": {
            "captures": c.captures, "splats": c.splats, "masks": c.masks,
            "weights": {k: {"sha256": sha, "probe": p} for k, (sha, p) in c.weights.items()},
        },
        "cells": [
            {"id": cell.id, "title": title(cell), "scene": cell.scene, "kind": cell.spec["kind"],
             "edit": cell.spec.get("edit"), "variants": list(cell.labels), "seed": cell.seed}
            for cell in planned.cells
        ],
    }  # fmt: skip


def title(cell: Cell) -> str:
    """Description of a cell."""
    edit = f" / {cell.spec['edit']}" if "edit" in cell.spec else ""
    return f"{cell.scene}{edit} / {cell.variant}" + (f" / seed {cell.seed}" if cell.seed else "")
