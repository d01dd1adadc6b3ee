"""Cells of a run on captures: one capture x edit x variant x seed, its files and its figures.

A cell's id is the hash of its inputs, which are checked before anything runs.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch

from attnwarp.command.edit import mask_files
from attnwarp.command.page import PAGE, show_edit
from attnwarp.digest import digest
from attnwarp.editing.editor import Editor
from attnwarp.editing.small import (
    check_words,
    dtype_of,
    guide_of,
    load_editor,
    own_steps_of,
    thread_count,
)
from attnwarp.encoders import Kind
from attnwarp.errors import InputError
from attnwarp.fit.views import to_float
from attnwarp.gaussians import Gaussians
from attnwarp.methods import METHODS, Budget, preset
from attnwarp.methods.algorithms.attention_warping import check_editor
from attnwarp.methods.base import workdir_of
from attnwarp.methods.pictures import enlarged_change, to_bytes
from attnwarp.methods.scene import near_of, render_picture
from attnwarp.reporting import SILENT, Reporter
from attnwarp.workdir import MANIFEST
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.encoders import load_encoder
from attnwarp_eval.files import write_picture
from attnwarp_eval.study.cell import Cell, merged
from attnwarp_eval.study.record import Json
from attnwarp_eval.study.shared import editing_methods
from attnwarp_eval.study.shared.editing_methods import (
    EDITING_METHODS,
    EditedScene,
    needs_source_words,
    with_source_words,
)
from attnwarp_eval.study.shared.edits import files_digest
from attnwarp_eval.study.store import Store
from attnwarp_eval.user_images import measure
from attnwarp_lab.captures.capture import (
    FITS,
    ORIGINALS,
    check_likeness,
    marks_of,
    read_splats,
    ready,
    segments,
)
from attnwarp_lab.captures.manifest import Loaded, Row

MADE = "made"
"""Folder of a run with the files of its cells."""

PROTOCOL = 2
"""Version; raised when the same inputs would give other figures."""

COUNTED = ("network_rows", "edits", "iterations")
"""Counters of a method kept in records."""

GUIDES = {"igs2gs": "picture", "dge": "picture", "fused": "picture", "gaussctrl": "depth"}
"""Kinds of editors that methods take; the others take both."""

KINDS: tuple[Kind, ...] = ("clip", "dino", "perceptual")


@lru_cache(maxsize=1)
def editor_of(name: str, device: str) -> Editor:
    """Load an editor; the last one is kept."""
    return load_editor(name, device=device, dtype=dtype_of("auto", device, name))


@cache
def encoder_of(name: str, kind: Kind, *, device: str) -> Any:
    """Load an encoder; cells are tuned and measured with the same few."""
    return load_encoder(name, kind, device=device)


@contextmanager
def _at(place: str) -> Iterator[None]:
    """Begin messages of a block with the key at fault."""
    try:
        yield
    except (InputError, FileNotFoundError, ValueError) as error:
        text = str(error)
        raise InputError(text if text.startswith(place) else f"{place}: {text}") from None


@dataclass(frozen=True)
class Run:
    """A run on captures.

    Attributes:
        loaded: its manifest.
        root: its folder.
        device: "cpu" or "cuda", with a number or without.
        report: hears how far the work is.
    """

    loaded: Loaded
    root: Path
    device: str
    report: Reporter = SILENT

    def plan(self) -> tuple[list[Cell], list[str]]:
        """Check the inputs of a manifest, and plan its cells, with notes on omitted ones.

        Raises:
            InputError: an input cannot be used; the message begins with its key in the manifest.
        """
        m = self.loaded.manifest
        captures: dict[str, Json] = {}
        for name in m.captures:
            with _at(f"captures.{name}"):
                captures[name] = self._check_capture(name, captures)
        weights: dict[str, str] = {}
        sizes: dict[str, int] = {}
        for name in m.editors:
            with _at(f"editors.{name}"):
                weights[name], sizes[name] = self._check_editor(name)
        encoders: dict[str, str] = {}
        for kind in KINDS:
            with _at(f"encoders.{kind}"):
                about = encoder_of(self.loaded.encoder(kind), kind, device=self.device).about
                encoders[kind] = about.weights_sha256
        cells: list[Cell] = []
        notes: list[str] = []
        for (scene, edit), (variant, row) in (
            (edit, row) for edit in self.loaded.edits() for row in m.variants.items()
        ):
            words = m.captures[scene].edits[edit]
            for seed in self.loaded.seeds(row):
                settings = settings_of(self.loaded, row, seed, sizes[row.editor])
                if needs_source_words(settings) and words.source is None:
                    notes.append(
                        f"left out: {scene} / {edit} / {variant}: it inverts with the words for the"
                        " scene before, which the edit lacks; give `source` (--source-prompt)"
                    )
                    break
                spec = {
                    "probe": "captures", "protocol": PROTOCOL, **captures[scene],
                    "splats": captures[scene]["splats"].get(row.splats) or _fit(m.fit, row.splats),
                    "edit": edit, "method": row.method, "seed": seed, "budget": row.budget,
                    "settings": with_source_words(settings, words.source or ""),
                    "text": words.text(guide_of(self.loaded.editor(row.editor))),
                    "words": {"source": words.source, "target": words.target},
                    "editor": weights[row.editor], "encoders": encoders,
                }  # fmt: skip
                cells.append(Cell(spec, scene, variant, "captures", seed, (variant,)))
        if not cells:
            raise InputError("; ".join(notes))
        return merged(cells), notes

    def _check_capture(self, name: str, before: Mapping[str, Json]) -> Json:
        capture, part = ready(self.loaded, name), self.loaded.manifest.captures[name]
        same = [other for other, spec in before.items() if spec["capture"] == capture.content]
        if same:
            raise InputError(f"has the pictures and cameras of {same[0]!r}; name a capture once")
        splats = {}
        for kind, file in part.splats.items():
            with _at(f"captures.{name}.splats.{kind}"):
                given = read_splats(self.loaded.path(file), kind)
                splats[kind] = given.digest()
                check_likeness(str(file), self.loaded.path(file), capture, given)
        mask = None
        if part.mask is not None:
            with _at(f"captures.{name}.mask"):
                segments(self.loaded, name, self.root, self.device, self.report)
                marks = marks_of(self.loaded, name)
                files = [marks.mask] if marks.mask else []
                files += mask_files(marks.masks, capture.views.cameras) if marks.masks else []
                mask = digest(part.mask.model_dump(mode="json"), *(p.read_bytes() for p in files))
        return {"capture": capture.content, "splats": splats, "mask": mask}

    def _check_editor(self, name: str) -> tuple[str, int]:
        """SHA-256 of an editor's files, and the longest side in px at which it works."""
        m, folder = self.loaded.manifest, self.loaded.editor(name)
        editor = editor_of(folder, self.device)
        for scene, edit in self.loaded.edits():
            text = m.captures[scene].edits[edit].text(editor.guide)
            with _at(f"captures.{scene}.edits.{edit}"):
                editor.check_text(text)
                check_words(folder, text, anyway=True)
        for variant, row in m.variants.items():
            if row.editor != name:
                continue
            wanted = GUIDES.get(row.method, editor.guide)
            if wanted != editor.guide:
                raise InputError(
                    f"variants.{variant}: {row.method} takes an editor guided by a {wanted}, and"
                    f" {name!r} is guided by a {editor.guide}; name another editor"
                )
            if row.method == "attention_warping":
                with _at(f"variants.{variant}"):
                    own = {"steps": editor.own_steps, **row.options}
                    check_editor(editor, preset(row.method, row.preset, **own))
        return files_digest(folder), m.size or editor.own_size

    def rows(self, cell: Cell) -> int | None:
        """Network rows that a cell's method plans; None for a method that does not tell them."""
        if cell.spec["method"] not in METHODS:
            return None
        with tempfile.TemporaryDirectory() as folder:
            nothing = Budget(network_rows=0)
            splats = self._splats(cell, SILENT, first=True)
            result = self._edited(cell, splats, Path(folder), nothing, SILENT)
        return sum(part.rows for part in result.rounds)

    def compute(self, cell: Cell, report: Reporter) -> Json:
        """Edit a capture by a variant's method, and measure the result: its record."""
        capture, folder = ready(self.loaded, cell.scene), self.root / MADE / cell.id[:16]
        before = self._splats(cell, report)
        budget = Budget.from_dict(self._row(cell).budget)
        result = self._edited(cell, before, folder / "run", budget, report)
        originals = self.root / ORIGINALS / cell.scene
        images = [capture.views.picture(k) for k in range(len(capture.views))]
        near = near_of(capture.views.cameras, before)
        for k, camera in enumerate(capture.views.cameras):
            _write(originals, k, images[k])
            _write(folder / "renders", k, render_picture(result.gaussians, camera, near, "auto"))
        for k, pixels in result.edited.items():
            _write(folder / "edited", k, enlarged_change(images[k], to_float(pixels)))
        page = None
        method = workdir_of(folder / "run")
        if method.has(MANIFEST):  # an external method leaves no such folder
            page = (method.path / PAGE).relative_to(self.root).as_posix()
            if not method.has(PAGE):
                show_edit(method, before, capture.views)
        counts = {k: result.counters[k] for k in COUNTED if k in result.counters}
        record = {
            "folder": folder.relative_to(self.root).as_posix(), "page": page, "cut": result.cut,
            "figures": self._figures(cell, result, folder, originals),
            "counts": {"views": len(images), "edited": len(result.edited), **counts},
            "seconds": result.seconds,
        }  # fmt: skip
        return without_nan(record)

    def _row(self, cell: Cell) -> Row:
        return self.loaded.manifest.variants[cell.variant]

    def _splats(self, cell: Cell, report: Reporter, *, first: bool = False) -> Gaussians:
        """Splats of a cell's capture: the manifest's, or fitted ones; with ``first``, those that a
        fit begins with.
        """
        from attnwarp.fit import FitSettings, first_splats, fit

        kind = self._row(cell).splats
        file = self.loaded.manifest.captures[cell.scene].splats.get(kind)
        if file is not None:
            return read_splats(self.loaded.path(file), kind).to(device=self.device)
        capture, settings = (
            ready(self.loaded, cell.scene),
            FitSettings.from_dict(cell.spec["splats"]),
        )
        start = first_splats(capture.dataset, capture.views.cameras, settings, report)
        start = start.to(device=self.device)
        if first:
            return start
        folder = self.root / FITS / f"{cell.scene}-{kind}-{digest(cell.spec['splats'])[:8]}"
        folder.mkdir(parents=True, exist_ok=True)
        done = fit(start, capture.views, settings, folder=folder, report=report).gaussians
        place = f"captures.{cell.scene}: fit of {kind}gs"
        check_likeness(place, folder, capture, done.to(device="cpu"))
        return done

    def _edited(
        self,
        cell: Cell,
        splats: Gaussians,
        folder: Path,
        budget: Budget,
        report: Reporter,
    ) -> EditedScene:
        """The result of a cell's method."""
        from attnwarp.fit import compile_kernels

        spec, capture = cell.spec, ready(self.loaded, cell.scene)
        editor = editor_of(self.loaded.editor(self._row(cell).editor), self.device)
        torch.set_num_threads(thread_count(editor))
        compile_kernels(splats.kind, report, self.device)
        marked = segments(self.loaded, cell.scene, self.root, self.device, SILENT)
        job = editing_methods.Job(
            splats, capture.views.cameras, capture.views.images, editor, spec["text"],
            spec["settings"], folder, None, {}, budget, segments=marked(splats),
            source=capture.source, masks=capture.views.masks, report=report, load=encoder_of,
        )  # fmt: skip
        return EDITING_METHODS[spec["method"]].run(job)

    def _figures(
        self, cell: Cell, result: EditedScene, folder: Path, originals: Path
    ) -> dict[str, float]:
        """Figures by title; encoders in folders have the preprocessing of the paper's authors."""
        source = ready(self.loaded, cell.scene).source
        words = cell.spec["words"]
        inputs = measure.Inputs(
            folder / "renders", folder / "edited" if result.edited else None, originals,
            folder / "edited" / picture_name(source) if source in result.edited else None,
            words["target"], words["source"],
        )  # fmt: skip
        names: dict[Kind, str | None] = {kind: self.loaded.encoder(kind) for kind in KINDS}
        done = measure.measure(
            inputs, names, Store(folder / "measured"), device=self.device, load=encoder_of
        )
        return {row.title: row.value for row in done.rows}


def picture_name(view: int) -> str:
    """File name of a view's picture."""
    return f"view-{view:04d}.png"


def _write(folder: Path, view: int, picture: Any) -> None:
    write_picture(folder / picture_name(view), to_bytes(picture))


def _fit(settings: Mapping[str, Any], kind: str) -> Json:
    from attnwarp.fit import FitSettings

    return FitSettings.from_dict({**settings, "kind": kind}).to_dict()


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
