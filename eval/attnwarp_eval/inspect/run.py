"""What a run's folder has of one variant of a scene: the settings of its warp, its fitted splats,
and pictures of edited views.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attnwarp import Gaussians
from attnwarp.errors import InputError
from attnwarp.io import read_ply
from attnwarp.warp import WarpSettings
from attnwarp_eval.inspect.capture import BEFORE, EDITED, Image, read_picture
from attnwarp_eval.study.probes import probe
from attnwarp_eval.study.probes.fit import folder_of
from attnwarp_eval.study.record import PictureFile, Record
from attnwarp_eval.study.store import Store


@dataclass(frozen=True, eq=False)
class RunEdit:
    """Pictures of one edited view that a run has.

    Attributes:
        folder: of the run.
        source, target: names of the views.
        files: by what they show.
        steps: "before" and "edited".
    """

    folder: Path
    source: str
    target: str
    files: Mapping[str, PictureFile]
    steps: tuple[str, ...] = (BEFORE, EDITED)

    def edited(self, view: str) -> Image | None:
        """(h, w, 3) sRGB of the edited source or target."""
        return self._picture("source-edit" if view == self.source else "edited")

    def after(self, view: str, step: str) -> Image | None:
        """(h, w, 3) sRGB of the target, rendered after the edit."""
        return self._picture("render")

    def splats(self, step: str) -> None:
        """A run has no edited splats."""

    def details(self, view: str) -> dict[str, Image]:
        """Further pictures of the target, by title."""
        truth = self._picture("truth")
        return {} if truth is None else {"true edit": truth}

    def _picture(self, content: str) -> Image | None:
        file = self.files.get(content)
        if file is None:
            return None
        damaged = Store(self.folder).damaged_pictures([file.to_json()])
        if damaged:
            raise InputError(damaged[0])
        return read_picture(self.folder / file.path)


@dataclass(frozen=True, eq=False)
class Measured:
    """The records of one variant of a scene.

    Attributes:
        folder: of the run.
        spec: of an edit or of a fit; empty where the variant has neither.
        edits: by "edit/view", those of which the run has pictures.
    """

    folder: Path
    spec: Mapping[str, Any] = field(default_factory=dict)
    edits: Mapping[str, RunEdit] = field(default_factory=dict)

    @property
    def exact_mask(self) -> bool:
        """Whether the method injects features where the source truly sees the surface."""
        return self.spec.get("mask") == "truth"

    def settings(self) -> WarpSettings | None:
        """Of the editing method's warp; None where it has none."""
        warp = self.spec["settings"].get("warp") if "edit" in self.spec else None
        return None if warp is None else WarpSettings.from_dict(warp)

    def fitted(self) -> Gaussians | None:
        """The splats that were fitted to true pictures; None where none were.

        Raises:
            InputError: the run's folder lacks them.
        """
        if "fit" not in self.spec:
            return None
        file = folder_of(self.folder, self.spec) / "splats.ply"
        if not file.is_file():
            raise InputError(
                f"{file}: missing, so this variant's fitted splats cannot be shown; open another"
                " --variant, or run the study anew in another folder"
            )
        return read_ply(file)


def measured(
    folder: Path, cells: Iterable[Mapping[str, Any]], scene: str, seed: int, source: str
) -> dict[str, Measured]:
    """What a run has of its variants: those that edit the scene, or fit splats to it.

    Args:
        folder: of the run.
        cells: the expected ones, as ``study.json`` lists them.
        scene, seed: of the cells to read.
        source: name of the source view.

    Raises:
        StoreError: a record is damaged.
    """
    store = Store(folder)
    done = store.done()
    specs: dict[str, Mapping[str, Any]] = {}
    edits: dict[str, dict[str, RunEdit]] = {}
    sampled = set()
    for cell in cells:
        if (cell["scene"], cell["seed"]) != (scene, seed) or cell["id"] not in done:
            continue
        record: Record[Any] = store.read_as(cell["id"], probe(cell["probe"]).read)
        for name in cell["variants"]:
            if "edit" in record.spec:
                specs[name] = record.spec
                edits.setdefault(name, {}).update(_edits(folder, record, source))
            elif "fit" in record.spec:
                specs.setdefault(name, record.spec)
            else:
                sampled.add(name)
    return {
        name: Measured(folder, spec, edits.get(name, {}))
        for name, spec in specs.items()
        # Where a variant is also measured on sampled splats, its warp is theirs.
        if "edit" in spec or name not in sampled
    }


def _edits(folder: Path, record: Record[Any], source: str) -> dict[str, RunEdit]:
    files: dict[str, dict[str, PictureFile]] = {}
    for picture in record.pictures:
        files.setdefault(picture.view, {})[picture.content] = picture
    return {
        name: RunEdit(folder, source, name.rpartition("/")[2], own)
        for name, own in files.items()
        if {"edited", "source-edit"} <= own.keys()
    }
