"""One variant of a scene in a run: settings of its warp, fitted splats, edited views."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp import Gaussians
from attnwarp.errors import InputError
from attnwarp.io import read_ply
from attnwarp.warp import WarpSettings
from attnwarp_eval.inspect.capture import BEFORE, EDITED, Image, read_picture
from attnwarp_eval.study.store import Store

if TYPE_CHECKING:
    from attnwarp_eval.study.probe import Probe
    from attnwarp_eval.study.record import PictureFile, Record


@dataclass(frozen=True, eq=False)
class RunEdit:
    """A run's pictures of one edited view, "before" and "edited"."""

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
        """Return None: a run has no edited splats."""

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
    """Parts of the records of a scene's variant that concern its warp.

    Attributes:
        edited: whether an editing method was measured, else only a fit.
        settings: settings of the method's warp; None without one.
        exact_mask: whether the method injects features where the source truly sees the surface.
        fit: file of the splats that were fitted to true pictures; None without a fit.
        edits: edits with pictures in the run, by "edit/view".
    """

    edited: bool = False
    settings: WarpSettings | None = None
    exact_mask: bool = False
    fit: Path | None = None
    edits: Mapping[str, RunEdit] = field(default_factory=dict)

    def fitted(self) -> Gaussians | None:
        """Read the splats fitted to true pictures; None without a fit.

        Raises:
            InputError: the run's folder lacks them.
        """
        if self.fit is None:
            return None
        if not self.fit.is_file():
            raise InputError(
                f"{self.fit}: missing, so this variant's fitted splats cannot be shown; open"
                " another --variant, or run the study anew in another folder"
            )
        return read_ply(self.fit)


def measured(
    folder: Path,
    cells: Iterable[Mapping[str, Any]],
    scene: str,
    seed: int,
    source: str,
    *,
    content: str,
) -> dict[str, Measured]:
    """Variants of a run that edit the scene or fit splats to it.

    Args:
        cells: the expected cells of ``study.json``.
        scene, seed: scene and seed of the cells to read.
        content: hash of the scene's present content.

    Raises:
        StoreError: a record is damaged.
        InputError: a cell was measured on an earlier version of the scene.
    """
    from attnwarp_eval.study.probe import probes

    store = Store(folder)
    done, available = store.done(), {p.name: p for p in probes()}
    result: dict[str, Measured] = {}
    sampled = set()
    for cell in cells:
        own = available.get(cell["probe"])
        if (cell["scene"], cell["seed"]) != (scene, seed) or cell["id"] not in done or own is None:
            continue
        if own.times_in_turn:
            continue  # several variants in one record, only for their seconds
        read = partial(_measured, folder, source, own)
        measured_of, one = store.read_as(cell["id"], read)
        if measured_of != content:
            raise InputError(
                f"{folder}: the scene {scene!r} has changed since the run was made; run the study"
                " again, or name the scene instead of the run"
            )
        for name in cell["variants"]:
            if one is None:
                sampled.add(name)
            elif one.edited:
                former = result.get(name, one).edits
                result[name] = replace(one, edits={**former, **one.edits})
            else:
                result.setdefault(name, one)
    # If a variant is also measured on sampled splats, its warp uses those.
    return {name: one for name, one in result.items() if one.edited or name not in sampled}


def _measured(
    folder: Path, source: str, own: Probe[Any], data: dict[str, Any]
) -> tuple[str, Measured | None]:
    """Hash of the scene, and contents of a record; None if it neither edits nor fits."""
    from attnwarp_eval.study.shared.fits import folder_of

    record = own.read(data)
    spec = record.spec
    edited = "edit" in spec
    if not edited and "fit" not in spec:
        return spec["scene"], None
    warp = spec["settings"].get("warp") if edited else None
    one = Measured(
        edited,
        None if warp is None else WarpSettings.from_dict(warp),
        spec.get("mask") == "truth",
        folder_of(folder, spec) / "splats.ply" if "fit" in spec else None,
        _edits(folder, record, source),
    )
    return spec["scene"], one


def _edits(folder: Path, record: Record[Any], source: str) -> dict[str, RunEdit]:
    files: dict[str, dict[str, PictureFile]] = {}
    for picture in record.pictures:
        files.setdefault(picture.view, {})[picture.content] = picture
    return {
        name: RunEdit(folder, source, name.rpartition("/")[2], own)
        for name, own in files.items()
        if {"edited", "source-edit"} <= own.keys()
    }
