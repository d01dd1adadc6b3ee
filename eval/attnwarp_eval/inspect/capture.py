"""A user's scene: splats, cameras with pictures, and optionally the folder of an edit."""

from __future__ import annotations

import glob
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import Camera, Gaussians
from attnwarp.camera import up_of
from attnwarp.errors import InputError, suggest
from attnwarp.io import Dataset, read_image, read_ply
from attnwarp.io.names import file_stems
from attnwarp.render import render
from attnwarp.warp import PRESETS, Surface, WarpSettings, render_surface
from attnwarp.warp.settings import DepthStatistic, SplatDepth

Image = npt.NDArray[np.float32]


BEFORE, EDITED = "before", "edited"
"""First and last step of an edit."""


class Capture:
    """Cameras with pictures, and the splats of the scene.

    Args:
        model: the splats, before any edit.
        dataset: the cameras and the files of their pictures.
        source: name of the source view; the first if None.
        size: longest side of the pictures in px; larger ones are averaged down.

    Attributes:
        near: near-plane depth in scene units, as in a fit and an edit.
        targets: all other cameras by the name of their file, without suffix.
        center, up: (3,) point and direction, as those of an orbit on an edit's page.

    Raises:
        InputError: fewer than two cameras, or no source of that name.
    """

    def __init__(
        self, model: Gaussians, dataset: Dataset, *, source: str | None = None, size: int = 512
    ) -> None:
        if len(dataset.cameras) < 2:
            raise InputError(
                f"DATA: got {len(dataset.cameras)} camera, expected at least a source and a target"
            )
        self.model, self.dataset, self.size = model, dataset, size
        names = file_stems(dataset.cameras)
        cameras = [
            replace(_resized(camera, size), name=name)
            for camera, name in zip(dataset.cameras, names, strict=True)
        ]
        source = names[0] if source is None else source
        one_of(source, names, "source")
        # Import here: the fit's losses and networks import slowly.
        from attnwarp.command.page.turntable import focus_of
        from attnwarp.methods.scene import near_of

        self.near = near_of(cameras, model)
        self.names = names
        self.source = cameras[names.index(source)]
        self.targets = {camera.name: camera for camera in cameras if camera.name != source}
        self.center, self.up = focus_of(cameras, model.world_means()), up_of(cameras)[0]
        self.image: Callable[[str], Image] = cache(self._image)
        self._rendered: Callable[..., Surface] = cache(self._render)

    def camera(self, name: str) -> Camera:
        """The source or a target by its name."""
        return self.source if name == self.source.name else self.targets[name]

    def surface(self, name: str, settings: WarpSettings) -> Surface:
        """Surface of the splats in a view, rendered once for all settings that render alike."""
        return self._rendered(name, settings.depth, settings.depth_statistic)

    def _render(self, name: str, depth: SplatDepth, depth_statistic: DepthStatistic) -> Surface:
        settings = WarpSettings(depth=depth, depth_statistic=depth_statistic)
        return render_surface(self.model, self.camera(name), settings, near=self.near)

    def _image(self, name: str) -> Image:
        """(H, W, 3) sRGB of a view in [0, 1]: its picture, or a render if it has none."""
        index, data = self.names.index(name), self.dataset
        if data.image_paths[index] is None:
            return np.clip(np.asarray(self.surface(name, PRESETS["corrected"]).image), 0, 1)
        # Import here: the fit's losses and networks import slowly.
        from attnwarp.fit import load_views

        one = Dataset([data.cameras[index]], [data.image_paths[index]], lenses=[data.lenses[index]])
        views = load_views(one, max_size=self.size)
        return views.target(0, np.zeros(3)).numpy()


@dataclass(frozen=True, eq=False)
class Edit:
    """The files of an edit of a scene, made by ``attnwarp edit``.

    Attributes:
        path: folder of the edit.
        views: names of the edited target views.
        steps: "before", the stages, and "edited" once the edit is done.
    """

    path: Path
    instruction: str
    source: str
    views: tuple[str, ...]
    settings: WarpSettings
    steps: tuple[str, ...]

    def splats(self, step: str) -> Gaussians:
        """The splats after a step other than "before"."""
        number = step.removeprefix("stage ")
        return read_ply(self.path / ("edited.ply" if step == EDITED else f"rounds/{number}.ply"))

    def edited(self, view: str) -> Image | None:
        """(h, w, 3) the edited picture of a view, of the last round that edited it."""
        paths = self.path.glob(f"rounds/*/{glob.escape(view)}.png")
        last = max(paths, key=lambda path: int(path.parent.name), default=None)
        return None if last is None else read_picture(last)

    def after(self, view: str, step: str) -> Image | None:
        """(h, w, 3) render of the scene after a step; None if the edit has not written it."""
        return self._picture(f"renders/after/{view}.png") if step == EDITED else None

    def _picture(self, name: str) -> Image | None:
        """(h, w, 3) sRGB of a file of the folder; None if the edit has not written it."""
        path = self.path / name
        return read_picture(path) if path.is_file() else None


def read_picture(path: Path) -> Image:
    """(h, w, 3) sRGB of a file, in [0, 1]."""
    pixels = read_image(path)
    return (pixels[..., :3] / np.iinfo(pixels.dtype).max).astype(np.float32)


def is_edit(path: Path) -> bool:
    """Return True if a folder contains an edit."""
    return (path / _manifest()).is_file()


def _manifest() -> str:
    from attnwarp.workdir import MANIFEST

    return MANIFEST


def read_edit(path: Path, names: Sequence[str]) -> Edit:
    """Read the edit in a folder.

    Args:
        names: names of the data set's views, without suffix.

    Raises:
        InputError: the manifest is damaged, or the edit belongs to another data set.
    """
    file = path / _manifest()
    try:
        manifest: Any = json.loads(file.read_text(encoding="utf-8"))
        source, instruction = manifest["source"], manifest["instruction"]
        edited = [name for part in manifest["rounds"] for name in part["views"]]
        views = [name for name in edited if name != source]
        settings = WarpSettings.from_dict(manifest["settings"]["warp"])
    except (ValueError, KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{file}: not the manifest of an edit ({reason}); make it with attnwarp edit"
        ) from None
    missing = sorted({source, *views} - set(names))
    if missing:
        raise InputError(
            f"{path}: is an edit of a view {missing[0]!r}, which DATA has not; expected the data"
            " set that was edited"
        )
    stages = [
        f"stage {number + 1}"
        for number in range(len(manifest["rounds"]))
        if (path / f"rounds/{number + 1}.ply").is_file()
    ]
    if (path / "edited.ply").is_file():
        # The last stage's splats are the edited ones.
        stages = [*stages[: len(manifest["rounds"]) - 1], EDITED]
    return Edit(path, instruction, source, tuple(views), settings, (BEFORE, *stages))


def rendered(model: Gaussians, camera: Camera, near: float) -> Image:
    """(H, W, 3) render of splats over black, in [0, 1]."""
    with torch.no_grad():
        color = render(model, camera, near=near).color
    return np.asarray(color.clamp(0, 1).float().cpu().numpy())


def one_of(value: str, choices: Sequence[str], name: str) -> None:
    """Refuse an unknown choice, and suggest the nearest one.

    Raises:
        InputError: ``value`` is none of ``choices``.
    """
    if value not in choices:
        listed = ", ".join(choices[:12]) + (", ..." if len(choices) > 12 else "")
        raise InputError(
            f"{name}: got {value!r}{suggest(value, choices)}; expected one of {listed}"
        )


def _resized(camera: Camera, longest: int) -> Camera:
    """The camera of a picture that :func:`attnwarp.fit.load_views` averages down."""
    factor = longest / max(camera.width, camera.height)
    if factor >= 1:
        return camera
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    return camera.resize(width, height)
