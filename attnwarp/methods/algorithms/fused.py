"""EditSplat (Lee et al. 2025): edit each view alone, then again under the guidance of the nearest
views' edits, fused into the view along depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp.editing.editor import tensor_of
from attnwarp.editing.editors.pix2pix import InstructPix2Pix, Pix2PixTask
from attnwarp.editing.schedule import Grid, following
from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Loop, ViewEdit
from attnwarp.methods.by_warps import ByWarps, CarriedSettings
from attnwarp.methods.doors import door
from attnwarp.methods.geometry import Warps
from attnwarp.methods.pictures import Image, Segment, Size
from attnwarp.methods.settings import needs_start
from attnwarp.methods.work import Work
from attnwarp.settings import Count, Share

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class FusedSettings(CarriedSettings):
    """Settings of :func:`attnwarp.methods.fused`.

    Args:
        start: (lowest, highest) range of the starting timestep, drawn for each edit.
        grid: grid of the steps below the start, :data:`attnwarp.editing.schedule.Grid`.
        batch: unused; views are edited one at a time.
        nearest: number of other views that are fused.
        fusion_share: s_M / (s_S + s_M), the part of the image guidance that leads to the fusion.
        occlusion: True lets the nearest of a view's pixels that fall into one win, False the last.
        holes: picture where no view's pixels fall, the "original" or "black".
        perceptual_scaled: False feeds the perceptual loss pictures in [0, 1] as if they were in
            [-1, 1].

    Example:
        >>> from attnwarp.methods import preset
        >>> preset("fused", "released").holes
        'black'
    """

    start: tuple[int, int] | None = (700, 980)
    grid: Grid = "even"
    nearest: Count = 5
    fusion_share: Share = 2 / 3
    occlusion: bool = True
    holes: Literal["original", "black"] = "original"
    perceptual_scaled: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        needs_start(self.start)


class Fused(ByWarps):
    """Edit every view twice, alone and guided by the fused edits of others, then tune the splats.

    The nearest views' first edits are splatted into a view and blended into F, outside the segment
    the view's picture I. The second edit's noise is e0(I) + s_T (eT(F) - eI(F)) + s_S (eI(I) -
    e0(I)) + s_M (eI(F) - e0(F)): T with text and picture, I with the picture, 0 with neither.

    The authors also drop first edits by a learned reward, find masks by words, and remove and add
    splats by cross-attention; here all edits serve, masks are ``segments``, and the number of
    splats is constant. Pixels have their centres at +0.5; in the authors' code, at whole numbers.
    Its noise is added at the first step of the grid, here at the timestep drawn.

    Args:
        gaussians, cameras, images, instruction, options: see :func:`by_view`.
        editor: an InstructPix2Pix.
        settings: :class:`FusedSettings`; the defaults if omitted.
        warps: see :func:`attention_warping`; positions and depth are read, not the mask.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import FusedSettings, fused
        >>> from attnwarp.trial import disc, view
        >>> quick = FusedSettings(steps=1, iterations=1)
        >>> views, editor = [view(0), view(1)], load_editor("small-plain")
        >>> result = fused(disc(), views, None, editor, "red", quick)
        >>> result.counters["network_rows"]  # two branches of a view, then six rows
        16
    """

    def __init__(self, work: Work, settings: FusedSettings, warps: Warps | None = None) -> None:
        work.takes("fused", "picture", InstructPix2Pix)
        assert settings.start is not None
        work.starts_at(settings.start[0], "start")
        self.settings = settings
        super().__init__(work, settings, warps)

    def run(self, loop: Loop) -> None:
        """Edit all views alone, then all again, then tune."""
        work, s = self.work, self.settings
        views = range(len(work.sizes))
        for view in views:
            rows = s.steps * work.branches()
            loop.edit(0, (view,), partial(self.edit_alone, view), rows=rows)
        for view in views:
            loop.edit(1, (view,), partial(self.edit_again, view), rows=s.steps * ROWS)
        loop.tune(1, views, s.iterations)

    def edit_alone(self, view: int, model: Gaussians, step: Callable[[], None]) -> list[ViewEdit]:
        """Edit a view from its noised picture."""
        start = self._start(0, view)
        result = self.work.edit([view], step, start=start)
        return [ViewEdit(result.images[0], {"start": start})]

    def edit_again(self, view: int, model: Gaussians, step: Callable[[], None]) -> list[ViewEdit]:
        """Edit a view from its noised picture, guided by the others' first edits."""
        work, s, editor = self.work, self.settings, self.work.editor
        assert isinstance(editor, InstructPix2Pix)
        start, picture, others = self._start(1, view), work.picture(view), self.nearest(view)
        fusion = self.fusion(view, others)
        with work.guided(s.text_guidance), torch.no_grad():
            task = guided_by(
                editor, fusion, picture, work.instruction, work.regions([view]), s.fusion_share
            )
            x, timesteps = self.begin(1, view, start, s.grid)
            for now, then in following(timesteps):
                x = editor.schedule.step(task.predict(x, now), x, now, then)
                step()
            (edited,) = editor.decode(x)
        return [ViewEdit(edited, {"start": start, "from": [self.names[k] for k in others]})]

    def _start(self, number: int, view: int) -> int:
        assert self.settings.start is not None
        return self.work.timestep(number, view, self.settings.start)

    def nearest(self, view: int) -> list[int]:
        """List the nearest other views, by the distance of centres plus the angle in radians."""
        cameras = self.work.views.cameras
        own = cameras[view]

        def apart(k: int) -> float:
            angle = np.arccos(np.clip(own.forward @ cameras[k].forward, -1, 1))
            return float(np.linalg.norm(own.position - cameras[k].position) + angle)

        others = [k for k in range(len(cameras)) if k != view]
        return sorted(others, key=apart)[: self.settings.nearest]

    def fusion(self, view: int, others: Sequence[int]) -> Image:
        """Fuse other views' first edits into a view, (h, w, 3); outside its segment its picture."""
        work, s = self.work, self.settings
        size, before = work.sizes[view], work.picture(view)
        layers = []
        for k in others:
            # The warp "from" the view to another has the place of each of the other's pixels.
            places = self.of_edits(view, k).correspondence
            layers.append(splat(self.kept(0, k), places.xy, places.z, size, s.occlusion))
        picture, seen = blended(layers) if layers else (before, np.ones(size, bool))
        if s.holes == "original":
            picture = np.where(seen[..., None], picture, before)
        return work.composite(view, np.clip(picture, 0, 1).astype(np.float32))


_PAPER = FusedSettings(
    text_guidance=7.5, image_guidance=1.5, grid="scheduler", iterations=1000, normal=0.0,
    distortion=0.0, color_rate=1.0,
)  # fmt: skip

fused = door(
    Fused,
    {
        "default": FusedSettings(),
        "paper": _PAPER,
        "released": replace(_PAPER, occlusion=False, holes="black", perceptual_scaled=False),
    },
)


def splat(
    colors: Array, xy: Tensor, z: Tensor, size: Size, occlusion: bool
) -> tuple[Array, npt.NDArray[np.float64]]:
    """Write each pixel's colour into the pixel that it falls into.

    Args:
        colors: (h, w, 3).
        xy: (h, w, 2) places in px of the result; NaN where undefined.
        z: (h, w) depth in the result's camera.
        size: (H, W) of the result.
        occlusion: True lets the nearest of several win, False the last in order.

    Returns:
        (H, W, 3) picture, 0 where nothing falls, and (H, W) depth, infinite there.
    """
    h, w = size
    place, depth = xy.reshape(-1, 2).numpy(), z.flatten().numpy()
    inside = (place >= 0).all(axis=1) & (place[:, 0] < w) & (place[:, 1] < h) & (depth > 0)
    place, depth, values = place[inside].astype(int), depth[inside], colors.reshape(-1, 3)[inside]
    if occlusion:
        order = np.argsort(-depth, kind="stable")
        place, depth, values = place[order], depth[order], values[order]
    picture, nearest = np.zeros((h, w, 3), colors.dtype), np.full((h, w), np.inf)
    # Of repeated places numpy keeps the last.
    picture[place[:, 1], place[:, 0]] = values
    nearest[place[:, 1], place[:, 0]] = depth
    return picture, nearest


def blended(layers: Sequence[tuple[Array, Array]]) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Blend pictures from the farthest to the nearest: at depths d < D the nearer one's weight is
    D / (d + D).

    Args:
        layers: (h, w, 3) picture and (h, w) depth of each, infinite where it has none.

    Returns:
        (h, w, 3) picture, 0 without a layer, and (h, w) bool, True where there is one.
    """
    pictures, depths = (np.stack(parts) for parts in zip(*layers, strict=True))
    order = np.argsort(-depths, axis=0, kind="stable")
    depths = np.take_along_axis(depths, order, axis=0)
    pictures = np.take_along_axis(pictures, order[..., None], axis=0)
    result, far = np.zeros(pictures.shape[1:]), np.full(depths.shape[1:], np.inf)
    for picture, depth in zip(pictures, depths, strict=True):
        there = np.isfinite(depth)
        back = np.where(there, np.where(there, depth, 1) / (np.where(there, depth, 1) + far), 1)
        result = (1 - back[..., None]) * picture + back[..., None] * result
        far = np.where(there, depth, far)
    return result, np.isfinite(far)


ROWS = 6
"""Rows of a fused step, as published; that of the text with the picture has no weight."""


def guided_by(
    editor: InstructPix2Pix, fusion: Image, picture: Image, words: str,
    regions: Sequence[Segment] | None, share: float,
) -> Pix2PixTask:  # fmt: skip
    """Prepare an edit of one picture guided by a fusion of others' edits.

    Args:
        editor: editor; its image guidance is s_S + s_M.
        fusion, picture: (h, w, 3) F and I.
        regions: (H, W) edited region; None for all.
        share: s_M as a part of the image guidance.
    """
    task = editor.task([picture], words, regions)
    latents = editor.raw_latents(tensor_of([fusion, picture], "fusion", editor.factor))
    text, empty = editor.embed([words, ""])
    none = torch.zeros_like(latents[0])
    before = [latents[0], latents[0], none, latents[1], latents[1], none]
    of_text, of_fusion = editor.text_guidance, share * editor.image_guidance
    of_picture = editor.image_guidance - of_fusion
    return replace(
        task,
        text=torch.stack([text, empty, empty] * 2),
        before=torch.stack(before).to(editor.unet.dtype),
        shares={
            "text F": of_text,
            "image F": of_fusion - of_text,
            "uncond F": -of_fusion,
            "text": 0.0,
            "image": of_picture,
            "uncond": 1 - of_picture,
        },
    )
