"""A scene and an editor at work on it: guides, renders, and the noise of each edit."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.editor import Editor, guided, shared_noise
from attnwarp.editing.schedule import Grid
from attnwarp.gaussians import Gaussians
from attnwarp.methods.noise import FRESH, own_seed
from attnwarp.methods.pictures import Image, Segment, Size, composite, edit_size, resized
from attnwarp.methods.scene import Scene, near_of, render_picture
from attnwarp.methods.settings import MethodSettings
from attnwarp.reporting import Reporter
from attnwarp.warp import WarpSettings, lift_masks, render_surface
from attnwarp.workdir import Workdir

Guide = npt.NDArray[Any]
"""(h, w, 3) picture or (h, w) depth, as an editor takes it."""

NOISE, TIMESTEP, KEYS, VIEWS = range(4)
"""Purposes of random numbers: no two draws share their seed."""


class Work:
    """A scene and an editor at work on it.

    Args:
        gaussians: the splats before the edit.
        scene: cameras, pictures and segments.
        editor: see :mod:`attnwarp.editing`.
        instruction: in words.
        settings: settings of the method.
        backend: name of the renderer.
        folder: path of the run.
        report: receives how the run stands.

    Attributes:
        frozen: the splats before the edit, outside autograd.
        sizes: (h, w) px of each view's edit.
        near: nothing nearer is drawn.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        scene: Scene,
        editor: Editor,
        instruction: str,
        settings: MethodSettings,
        backend: str,
        folder: Workdir,
        report: Reporter,
    ) -> None:
        self.frozen, self.scene, self.editor = gaussians.detach(), scene, editor
        self.folder, self.report = folder, report
        self.instruction, self.settings, self.backend = instruction, settings, backend
        multiple = editor.side_multiple
        self.sizes: list[Size] = [
            edit_size(camera.height, camera.width, settings.size, multiple)
            for camera in scene.cameras
        ]
        self.near = near_of(scene.cameras, gaussians)

    def picture(self, view: int) -> Image:
        """(h, w, 3) of a view before the edit, at the size of its edit."""
        return resized(self.scene.picture(view), self.sizes[view])

    def render(self, view: int, model: Gaussians) -> Image:
        """(h, w, 3) of a view of the splats, at the size of its edit."""
        h, w = self.sizes[view]
        camera = self.scene.cameras[view].resize(w, h)
        return render_picture(model, camera, self.near, self.backend)

    def depth(self, view: int, model: Gaussians, warp: WarpSettings | None = None) -> Guide:
        """(h, w) depth of splats; NaN where undefined."""
        h, w = self.sizes[view]
        camera = self.scene.cameras[view].resize(w, h)
        settings = warp or WarpSettings()
        surface = render_surface(model, camera, settings, near=self.near, backend=self.backend)
        return np.asarray(surface.depth)

    def guide(self, view: int, model: Gaussians, warp: WarpSettings | None = None) -> Guide:
        """A view's picture, or the depth of splats, as the editor takes it."""
        if self.editor.guide == "picture":
            return self.picture(view)
        return self.depth(view, model, warp)

    def composite(self, view: int, picture: Image) -> Image:
        """The edit inside the view's segment, and outside what the settings say."""
        if self.scene.segments is None:
            return picture
        s, segment = self.settings, self.scene.segments[view]
        return composite(picture, self.picture(view), segment, s.composite, s.composite_blur)

    def membership(self) -> npt.NDArray[np.float64]:
        """(N,) in [0, 1]: how far each splat before the edit belongs to the segments.

        0 up to a half, where its pixels are not marked, and 1 from three quarters on.
        """
        segments = self.scene.segments
        assert segments is not None
        lifted = lift_masks(
            self.frozen, self.scene.cameras, segments, near=self.near, backend=self.backend
        )
        return np.asarray(np.clip(4 * lifted.membership - 2, 0, 1))

    def regions(self, views: Sequence[int]) -> list[Segment] | None:
        """Masks of views, for the noise of a bundled editor; None where everything is edited."""
        segments = self.scene.segments
        return None if segments is None else [segments[view] for view in views]

    def one_size(self, method: str) -> None:
        """Raise ValueError unless all views are edited at one size."""
        if len(set(self.sizes)) > 1:
            sizes = " and ".join(f"{w} x {h}" for h, w in sorted(set(self.sizes))[:2])
            raise ValueError(
                f"cameras: {method} edits views together, got edits of {sizes} px; crop the"
                " pictures to one shape"
            )

    def takes(self, method: str, guide: str, kind: type[Any] | None = None) -> None:
        """Raise ValueError unless the editor has the guide, or is of the class, that a method is
        made for.
        """
        kinds = {"picture": "InstructPix2Pix, which takes pictures", "depth": "a depth ControlNet"}
        editor = self.editor
        if editor.guide != guide or not (kind is None or isinstance(editor, kind)):
            got = type(editor).__name__ if editor.guide == guide else kinds[editor.guide]
            raise ValueError(
                f"editor: {method} is made for {kinds[guide]}, got {got}; choose another editor or"
                " method"
            )

    def starts_at(self, lowest: int, field: str) -> None:
        """Raise ValueError unless the settings' steps fit below a timestep to start from.

        Args:
            lowest: timestep of Stable Diffusion; where it fits, all above it do.
            field: field of the settings, for the error.
        """
        steps = self.settings.steps
        try:
            self.editor.schedule.published(lowest, steps, self.grid)
        except ValueError:
            raise ValueError(
                f"{field}: {lowest} leaves too few timesteps for {steps} steps on this editor's"
                " schedule; start higher or take fewer steps"
            ) from None

    def seed(self, purpose: int, *numbers: int) -> int:
        """A seed of its own for each purpose and numbers such as a round and a view."""
        return own_seed(self.settings.seed, purpose, *numbers)

    def generator(self, purpose: int, *numbers: int) -> torch.Generator:
        """Random numbers of their own for each purpose and numbers."""
        return torch.Generator().manual_seed(self.seed(purpose, *numbers))

    def noise(self, number: int, views: Sequence[int]) -> Tensor:
        """(B, C, h, w) noise of edits in a round; a view's does not depend on those beside it.

        In the first round it is that of attention warping with noise of each view's own, so that
        methods can be compared at equal noise.
        """
        one = (1, *self.editor.noise_shape(self.sizes[views[0]]))
        if self.settings.noise == "shared":
            return shared_noise((len(views), *one[1:]), self.settings.seed)
        purpose = (NOISE, number) if number else (FRESH,)
        seeds = [self.seed(*purpose, view) for view in views]
        return torch.cat([shared_noise(one, seed) for seed in seeds])

    def timestep(self, number: int, view: int, limits: tuple[int, int]) -> int:
        """Stable Diffusion's timestep that an edit starts from, drawn evenly within limits, both
        included.
        """
        low, high = limits
        views = () if self.settings.noise == "shared" else (view,)
        generator = self.generator(TIMESTEP, number, *views)
        return int(torch.randint(low, high + 1, (1,), generator=generator))

    @property
    def prompt(self) -> str:
        """The instruction with the settings' suffix, if they have one."""
        return self.instruction + getattr(self.settings, "suffix", "")

    @property
    def grid(self) -> Grid:
        """Grid of the steps below a start, if the settings have one."""
        grid: Grid = getattr(self.settings, "grid", "even")
        return grid

    def guided(self, text: float | None) -> AbstractContextManager[None]:
        """Use a text guidance, and the settings' image guidance and negative prompt, while a block
        runs; None leaves the editor's own.
        """
        return guided(
            self.editor,
            text_guidance=text,
            image_guidance=self.settings.image_guidance,
            negative_prompt=getattr(self.settings, "negative_prompt", None),
        )

    def branches(self) -> int:
        """Rows of the UNet's batch for one view."""
        with self.guided(self.settings.text_guidance):
            return len(self.editor.branches)


def chunks(views: Sequence[int], size: int) -> tuple[tuple[int, ...], ...]:
    """Views in groups of a size, in their order; the last may be smaller.

    Example:
        >>> chunks([4, 5, 6], 2)
        ((4, 5), (6,))
    """
    return tuple(tuple(views[k : k + size]) for k in range(0, len(views), size))


def parts_of(total: int, size: int) -> list[int]:
    """``total`` in parts of ``size`` and what is left; one part of 0 where there is none.

    Example:
        >>> parts_of(3000, 2500), parts_of(0, 10)
        ([2500, 500], [0])
    """
    full = [size] * (total // size)
    rest = total % size
    return [*full, rest] if rest or not full else full
