"""A scene and an editor at work on it: guides, renders, and the noise of each edit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.editor import Edit, Editor, edit, guided, shared_noise
from attnwarp.editing.schedule import Grid
from attnwarp.fit import Views
from attnwarp.gaussians import Gaussians
from attnwarp.methods.noise import FRESH, own_seed
from attnwarp.methods.pictures import Image, Segment, Size, composite, edit_size, resized
from attnwarp.methods.scene import near_of, render_picture
from attnwarp.methods.settings import MethodSettings
from attnwarp.reporting import Reporter
from attnwarp.warp import WarpSettings, lift_masks, render_surface
from attnwarp.workdir import Workdir

Guide = npt.NDArray[Any]
"""(h, w, 3) picture or (h, w) depth, depending on the editor."""

NOISE, TIMESTEP, KEYS, VIEWS = range(4)
"""Purposes of random numbers, so that no two draws share a seed."""


class Work:
    """A scene and an editor at work on it.

    Attributes:
        frozen: the splats before the edit, outside autograd.
        views: the views before the edit.
        segments: (H, W) bool, or float32 in [0, 1] with soft edges; None if everything is edited.
        sizes: (h, w) px of each view's edit.
        near: near-plane depth, in scene units.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Views,
        editor: Editor,
        instruction: str,
        settings: MethodSettings,
        backend: str,
        folder: Workdir,
        report: Reporter,
        segments: list[Segment] | None = None,
    ) -> None:
        self.frozen, self.editor = gaussians.detach(), editor
        self.views, self.segments = views, segments
        self.folder, self.report = folder, report
        self.instruction, self.settings, self.backend = instruction, settings, backend
        multiple = editor.side_multiple
        self.sizes: list[Size] = [
            edit_size(camera.height, camera.width, settings.size, multiple)
            for camera in views.cameras
        ]
        self.near = near_of(views.cameras, gaussians)

    def picture(self, view: int) -> Image:
        """Return a view's picture before the edit, (h, w, 3), at the size of its edit."""
        return resized(self.views.picture(view), self.sizes[view])

    def render(self, view: int, model: Gaussians, *, full: bool = False) -> Image:
        """Render a view of the splats, exposed as its picture, at the size of its edit, (h, w, 3),
        or at the picture's."""
        camera, (h, w) = self.views.cameras[view], self.sizes[view]
        shown = camera if full else camera.resize(w, h)
        exposed = partial(self.views.exposed, view)
        return render_picture(model, shown, self.near, self.backend, exposed)

    def depth(self, view: int, model: Gaussians, warp: WarpSettings | None = None) -> Guide:
        """Render the depth of splats, (h, w); NaN where undefined."""
        h, w = self.sizes[view]
        camera = self.views.cameras[view].resize(w, h)
        settings = warp or WarpSettings()
        surface = render_surface(model, camera, settings, near=self.near, backend=self.backend)
        return np.asarray(surface.depth)

    def guide(self, view: int, model: Gaussians, warp: WarpSettings | None = None) -> Guide:
        """Return a view's picture or the depth of splats, depending on the editor."""
        if self.editor.guide == "picture":
            return self.picture(view)
        return self.depth(view, model, warp)

    def edit(
        self,
        views: Sequence[int],
        step: Callable[[], None],
        *,
        number: int = 0,
        start: int | None = None,
        pictures: Sequence[Image] | None = None,
    ) -> Edit:
        """Edit views together, from their guides before the edit and their noise of a round.

        Args:
            start: Stable Diffusion's timestep to start from; None starts as the editor begins.
            pictures: pictures noised to ``start``; those before the edit if omitted.
        """
        if start is not None and pictures is None:
            pictures = [self.picture(view) for view in views]
        with self.guided(self.settings.text_guidance):
            return edit(
                self.editor,
                [self.guide(view, self.frozen) for view in views],
                self.instruction,
                steps=self.settings.steps,
                start=start,
                grid=self.grid,
                pictures=pictures,
                noise=self.noise(number, views),
                on_step=lambda *_: step(),
                regions=self.regions(views),
            )

    def composite(self, view: int, picture: Image) -> Image:
        """Compose the edit inside the view's segment with the settings' choice outside."""
        if self.segments is None:
            return picture
        s, segment = self.settings, self.segments[view]
        return composite(picture, self.picture(view), segment, s.composite, s.composite_blur)

    def membership(self) -> npt.NDArray[np.float64]:
        """Compute each splat's membership in the segments before the edit, (N,) in [0, 1].

        It is 0 if at most half of the splat's pixels are marked, and 1 from three quarters on.
        """
        segments = self.segments
        assert segments is not None
        lifted = lift_masks(
            self.frozen,
            self.views.cameras,
            segments,
            kept=self.views.masks,
            near=self.near,
            backend=self.backend,
        )
        return np.asarray(np.clip(4 * lifted.membership - 2, 0, 1))

    def regions(self, views: Sequence[int]) -> list[Segment] | None:
        """List views' masks for a bundled editor's noise; None if everything is edited."""
        segments = self.segments
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
        """Raise ValueError unless the editor has the guide, or is of the class, that a method
        needs.
        """
        kinds = {"picture": "InstructPix2Pix, which takes pictures", "depth": "a depth ControlNet"}
        editor = self.editor
        if editor.guide != guide or not (kind is None or isinstance(editor, kind)):
            takes = {"picture": "pictures", "depth": "depth maps"}[editor.guide]
            raise ValueError(
                f"editor: {method} is made for {kinds[guide]}, got {type(editor).__name__}, which"
                f" takes {takes}; choose another editor or method"
            )

    def starts_at(self, lowest: int, field: str) -> None:
        """Raise ValueError unless the settings' steps fit below a starting timestep."""
        steps = self.settings.steps
        try:
            self.editor.schedule.published(lowest, steps, self.grid)
        except ValueError:
            raise ValueError(
                f"{field}: {lowest} leaves too few timesteps for {steps} steps on this editor's"
                " schedule; start higher or take fewer steps"
            ) from None

    def seed(self, purpose: int, *numbers: int) -> int:
        """Derive a separate seed from a purpose and numbers such as a round and a view."""
        return own_seed(self.settings.seed, purpose, *numbers)

    def generator(self, purpose: int, *numbers: int) -> torch.Generator:
        """Create a separate random generator for a purpose and numbers."""
        return torch.Generator().manual_seed(self.seed(purpose, *numbers))

    def noise(self, number: int, views: Sequence[int]) -> Tensor:
        """Draw (B, C, h, w) noise of a round's edits; a view's noise is independent of its batch.

        In the first round it equals attention warping's noise drawn separately per view, so that
        methods can be compared at equal noise.
        """
        one = (1, *self.editor.noise_shape(self.sizes[views[0]]))
        if self.settings.noise == "shared":
            return shared_noise((len(views), *one[1:]), self.settings.seed)
        purpose = (NOISE, number) if number else (FRESH,)
        seeds = [self.seed(*purpose, view) for view in views]
        return torch.cat([shared_noise(one, seed) for seed in seeds])

    def timestep(self, number: int, view: int, limits: tuple[int, int]) -> int:
        """Draw the Stable Diffusion timestep at which an edit starts, evenly within limits, both
        included.
        """
        low, high = limits
        views = () if self.settings.noise == "shared" else (view,)
        generator = self.generator(TIMESTEP, number, *views)
        return int(torch.randint(low, high + 1, (1,), generator=generator))

    @property
    def prompt(self) -> str:
        """Instruction with the settings' suffix, if any."""
        return self.instruction + getattr(self.settings, "suffix", "")

    @property
    def grid(self) -> Grid:
        """Grid of the steps below a start, if the settings define one."""
        grid: Grid = getattr(self.settings, "grid", "even")
        return grid

    def guided(self, text: float | None) -> AbstractContextManager[None]:
        """Use a text guidance, and the settings' image guidance and negative prompt, while a block
        runs; None keeps the editor's default.
        """
        return guided(
            self.editor,
            text_guidance=text,
            image_guidance=self.settings.image_guidance,
            negative_prompt=getattr(self.settings, "negative_prompt", None),
        )

    def branches(self) -> int:
        """Number of rows in the UNet's batch for one view."""
        with self.guided(self.settings.text_guidance):
            return len(self.editor.branches)


def chunks(views: Sequence[int], size: int) -> tuple[tuple[int, ...], ...]:
    """Split views into groups of a size, in order; the last may be smaller.

    Example:
        >>> chunks([4, 5, 6], 2)
        ((4, 5), (6,))
    """
    return tuple(tuple(views[k : k + size]) for k in range(0, len(views), size))


def parts_of(total: int, size: int) -> list[int]:
    """Split ``total`` into parts of ``size`` and a remainder; a total of 0 gives one part of 0.

    Example:
        >>> parts_of(3000, 2500), parts_of(0, 10)
        ([2500, 500], [0])
    """
    full = [size] * (total // size)
    rest = total % size
    return [*full, rest] if rest or not full else full
