"""Subjects to inspect: a run, a scene, or a user's splats and cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from attnwarp import Gaussians
from attnwarp.errors import InputError
from attnwarp.io import read_dataset, read_ply, read_splat
from attnwarp.io.names import file_stems
from attnwarp.warp import PRESETS
from attnwarp_eval.inspect.capture import (
    BEFORE,
    EDITED,
    Capture,
    Edit,
    is_edit,
    one_of,
    read_edit,
)
from attnwarp_eval.inspect.pair import Pair
from attnwarp_eval.inspect.run import Measured, measured
from attnwarp_eval.study.schema import Splats, Variant
from attnwarp_eval.study.store import Store

if TYPE_CHECKING:
    from attnwarp_eval.world import World

SIZE = 512
"""Image size of a scene inspected by name, and longest side of a user's pictures."""

EDIT_VARIANT = "the edit's"
"""Name of the variant with the settings of an edit's manifest."""

_NOT_MEASURED = Measured()


@dataclass(frozen=True)
class Subject:
    """A scene with the variants and the target views that can be inspected.

    Attributes:
        scene: name or path of the scene.
        size: size of the images, in pixels.
        spp: samples a pixel of the true pictures.
        variants: splats by variant's name; None stands for the true depth, or for the user's
            splats.
        targets: names of the views.
        capture: the user's capture, without truth.
        measured: measured figures of a run's variants, where they edit the scene or fit splats to
            it.
        elsewhere: advice on the file to open for an edited view without pictures in the run; empty
            except for a run of edits.
    """

    scene: str
    size: int
    spp: int
    seed: int
    variants: dict[str, tuple[Variant, Splats | None]]
    targets: tuple[str, ...]
    capture: Capture | None = field(default=None, repr=False)
    edit: Edit | None = field(default=None, repr=False)
    measured: Mapping[str, Measured] = field(default_factory=dict, repr=False)
    elsewhere: str = ""
    _pairs: dict[tuple[str, str], Pair] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def pair(self, variant: str, target: str) -> Pair:
        """The pair of a target view and a variant; an edited view of a run is named ``edit/view``.

        Pairs are cached.

        Raises:
            InputError: no such variant or view.
        """
        one_of(variant, list(self.variants), "variant")
        one_of(target, list(self.targets), "view")
        if (variant, target) not in self._pairs:
            self._pairs[variant, target] = self._pair(variant, target)
        return self._pairs[variant, target]

    def _pair(self, variant: str, target: str) -> Pair:
        chosen, model = self.variants[variant]
        # Methods with separate presets have no warp: show the corrected rules instead.
        own_preset = chosen.preset is not None and chosen.preset not in PRESETS
        settings = PRESETS["corrected"] if own_preset else chosen.settings()
        if self.capture is not None:
            if variant == EDIT_VARIANT and self.edit is not None:
                settings = self.edit.settings
            return Pair(self.capture, target, settings, self.capture.model, edit=self.edit)
        from attnwarp_eval.world import splats, world

        own = self.measured.get(variant, _NOT_MEASURED)
        gaussians = None
        if model is not None:
            gaussians = own.fitted()
            if gaussians is None:
                gaussians = splats(self.scene, self.size, self.seed, **model.model_dump())
        return Pair(
            world(self.scene, self.size),
            target.rpartition("/")[2],
            own.settings or settings,
            gaussians,
            self.spp,
            own.edits.get(target),
            own.exact_mask,
        )

    @property
    def preferred(self) -> str:
        """The edit's variant, else "corrected", else the first with an edit's pictures, or any."""
        names = list(self.variants)
        edited = [name for name in names if name in self.measured and self.measured[name].edits]
        wanted = (EDIT_VARIANT, "corrected", *edited)
        return next((name for name in wanted if name in names), names[0])

    @property
    def steps(self) -> tuple[str, ...]:
        """Steps of the edits; a single unnamed one without edits."""
        if self.edit is not None:
            return self.edit.steps
        return (BEFORE, EDITED) if any(own.edits for own in self.measured.values()) else ("",)

    @cached_property
    def views(self) -> World | Capture:
        """The cameras and pictures."""
        if self.capture is not None:
            return self.capture
        from attnwarp_eval.world import world

        return world(self.scene, self.size)

    @cached_property
    def center(self) -> npt.NDArray[np.float64]:
        """(3,) look-at point of the cameras."""
        views = self.views
        center = views.center if isinstance(views, Capture) else views.scene.center
        return np.asarray(center, dtype=np.float64)

    @cached_property
    def up(self) -> npt.NDArray[np.float64]:
        """(3,) unit vector."""
        return self.views.up if isinstance(self.views, Capture) else np.array([0.0, 0, 1])


def of_scene(scene: str, size: int = SIZE) -> Subject:
    """A scene, by name or path, under the presets, with splats sampled on its surfaces.

    Raises:
        InputError: no such scene.
    """
    from attnwarp_eval.world import world

    model = Splats(position_noise=0.1, normal_noise=3.0)
    targets = tuple(world(scene, size).targets)
    return Subject(scene, size, 8, 0, _presets(model), targets)


def _presets(model: Splats | None) -> dict[str, tuple[Variant, Splats | None]]:
    return {name: (Variant(preset=name), model) for name in sorted(PRESETS)}


def of_run(
    folder: Path, scene: str | None = None, size: int | None = None, seed: int | None = None
) -> Subject:
    """A run's variants and views; edited views with pictures come first.

    Scene and seed are by default the first, and the size of the images is the run's.

    Raises:
        InputError: the folder is not a run, a record is damaged, the run has no such scene or seed
            or no variants, or the scene has changed since.
    """
    from attnwarp_eval.study.run import stored_study
    from attnwarp_eval.study.study import scene_files
    from attnwarp_eval.world import world

    stored = stored_study(Store(folder))
    study = stored.study
    if not study.scenes:
        raise InputError(f"{folder}: the study {study.name!r} has no scenes; name a scene instead")
    files = dict(zip(study.scene_names, scene_files(study), strict=True))
    name = scene or study.scene_names[0]
    one_of(name, list(files), "scene")
    seed = study.seeds[0] if seed is None else seed
    one_of(str(seed), [str(number) for number in study.seeds], "seed")
    variants = {
        name: (variant, None if variant.geometry == "truth" else study.splats_of(variant))
        for name, variant in study.variants.items()
    }
    if not variants:
        raise InputError(
            f"{folder}: the study {study.name!r} has no variants; name a scene instead"
        )
    size = size or study.size
    views = world(files[name], size)
    records = measured(
        folder, stored.cells, name, seed, views.source.name, content=views.content_hash
    )
    pictured = [name for name, own in records.items() if own.edits]
    edited = tuple(dict.fromkeys(view for name in pictured for view in records[name].edits))
    for view in edited:
        one_of(view.rpartition("/")[2], list(views.targets), f"{folder}: picture of the view")
    elsewhere = ""
    if any(own.edited for own in records.values()):
        elsewhere = _elsewhere(folder, pictured, edited)
    scene, seen = files[name], tuple(study.views or views.targets)
    return Subject(
        scene,
        size,
        study.spp,
        seed,
        variants,
        (*edited, *seen),
        measured=records,
        elsewhere=elsewhere,
    )


def _elsewhere(folder: Path, variants: Sequence[str], views: Sequence[str]) -> str:
    """Advice on the file to open for an edited view without pictures in the run."""
    other = "edit the scene with attnwarp edit, and open its folder with --data"
    if not views:
        return (
            f"{folder}: the run has no pictures of edited views; name variants and views under"
            f" pictures in its study and run it anew, or {other}"
        )
    return (
        f"{folder}: the run has pictures of the edited views {', '.join(views)} by the variants"
        f" {', '.join(map(repr, variants))} alone; open one of these with --view and --variant,"
        f" or {other}"
    )


def of_capture(
    path: Path,
    data: Path,
    *,
    ply: Path | None = None,
    images: Path | None = None,
    source: str | None = None,
    size: int = SIZE,
) -> Subject:
    """A user's scene: splats, or the folder of an edit, and the cameras with their pictures.

    Args:
        path: a PLY or .splat file, or a folder written by ``attnwarp edit``.
        data: transforms.json, its folder, or a COLMAP folder.
        ply: the splats before the edit, if the folder lacks them.
        images: folder of the pictures of a COLMAP model.
        source: name of the source view; by default the edit's, else the first.
        size: longest side of the pictures.

    Raises:
        InputError: the folder has no edit, the splats are missing, or no such view exists.
    """
    # A camera without a picture is shown with a render.
    dataset = read_dataset(data, images=images, missing_images="none", points=False)
    variants = _presets(None)
    edit = None
    if path.is_dir():
        from attnwarp.command.edit import FIT_FOLDER

        if not is_edit(path):
            raise InputError(
                f"{path}: expected splats (.ply, .splat, .spz, .sog, .ksplat) or a folder of"
                " attnwarp edit"
            )
        edit = read_edit(path, file_stems(dataset.cameras))
        source = source or edit.source
        variants = {EDIT_VARIANT: (Variant(preset="corrected"), None), **variants}
        if ply is None and not (path / FIT_FOLDER / "splats.ply").is_file():
            raise InputError(
                f"{path}: was made from splats of your own; name them with --ply FILE.ply"
            )
        ply = ply or path / FIT_FOLDER / "splats.ply"
    elif ply is not None:
        raise InputError(f"--ply: {path} is no folder of an edit; leave --ply out")
    capture = Capture(_splats(path if ply is None else ply), dataset, source=source, size=size)
    targets = tuple(capture.targets)
    if edit is not None:
        # Edited views come first.
        targets = tuple(sorted(targets, key=lambda name: name not in edit.views))
    return Subject(str(path), size, 0, 0, variants, targets, capture, edit)


def _splats(path: Path) -> Gaussians:
    return read_splat(path) if path.suffix.lower() == ".splat" else read_ply(path)
