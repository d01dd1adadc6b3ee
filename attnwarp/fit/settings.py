"""Settings of a fit: the published numbers, and the reasons for deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from attnwarp.gaussians import Kind
from attnwarp.settings import Count, Range, Settings, Share, Weight

Background = Literal["auto", "random", "black", "white"]
Sky = Literal[True, False, "x", "-x", "y", "-y", "z", "-z"]
Interval = Annotated[float, Range(1e-9, 1)]


@dataclass(frozen=True)
class FitSettings(Settings):
    """Settings of a fit. Equal settings, views, first splats and threads give equal bits.

    Learning rates and thresholds are those published for 3DGS and 2DGS, whose fits take 30,000
    iterations on a GPU. Fields named ``_from``, ``_until`` and ``_every`` are shares of
    ``iterations``, so that a shorter fit passes through all phases; only ``evaluate_every`` counts
    iterations.

    Args:
        kind: "2d" (2DGS) or "3d" (3DGS).
        iterations: number of optimisation steps, one view each.
        seed: seed of the order of views, the random background and the splitting of splats.
        sh_degree: degree of the colour's spherical harmonics, 0 to 3.
        sh_every: share of the iterations between increases of the used degree, which starts at the
            first splats' degree (0 for points).
        lr_means, lr_means_final: learning rates of the centres at the beginning and the end,
            exponential in between, times the scene's extent.
        lr_dc, lr_rest, lr_opacity, lr_scales, lr_quats: learning rates of the constant harmonic,
            the other harmonics, the opacity's logit, the scales' logarithm, and the
            quaternions.
        ssim: share of 1 - SSIM in the picture's loss; the rest is L1.
        normal: weight of normal consistency. None: 0.05 for "2d" (published), 0 for "3d".
        distortion: weight of depth distortion in units of the scene's extent, see
            :func:`attnwarp.losses.depth_distortion`. None: 0.01 for "2d", 0 for "3d".
        normal_from, distortion_from: share of the iterations after which these losses begin (2DGS:
            7,000 and 3,000 of 30,000).
        background: colour behind the splats and behind transparent pixels of the images: "black",
            "white" or "random". Random draws a new colour each iteration, so that no colour can
            imitate transparency. "auto" is random for images with transparency, else black.
        densify: True clones, splits and prunes splats.
        densify_from: share of the iterations after which splats are added.
        densify_every: share of the iterations between two refinements.
        densify_least: least number of iterations between two refinements, each of which shows one
            view: a splat's mean gradient rests on no fewer.
        densify_until: share of the iterations after which splats are neither added nor removed.
        grow_gradient: mean norm of the loss's gradient in a splat's screen position above which
            the splat is cloned or split, for a screen 2 wide and high.
        max_splats: largest number of splats after a refinement; splats of the largest gradient
            are preferred. None: no limit.
        prune_opacity: opacity below which splats are removed. None: 0.05 for "2d", 0.005 for "3d"
            (published).
        prune_scale: share of the extent above which splats are removed, from the first opacity
            reset or the middle of ``densify_until`` on, whichever is earlier.
        reset_every: share of the iterations between resets of all opacities to ``reset_opacity``,
            while splats are added.
        reset_least: least number of iterations between resets, which cost so many to recover from:
            a fit below twice as many has none.
        reset_opacity: opacity after a reset, in (0, 1).
        antialiased: True fits "3d" splats for the opacity-compensated rasteriser.
        near: near-plane depth, as a share of the extent.
        sky: True adds far splats to the first ones above the horizon, for pictures without
            transparency whose cameras tell the direction up; an axis of the world, such as "z" or
            "-y", is that direction; see :func:`attnwarp.fit.with_sky`.
        exposure: True fits an affine change of colour for each picture, absent from renders.
        evaluate_every: number of iterations between two evaluations on the held-out views, which
            also form the history.
        patience: number of evaluations after which the fit stops if the PSNR of the choosing views
            has not risen by ``min_gain`` dB. None: never, and no view chooses. The additional
            evaluation at a process's end does not count.
        min_gain: least gain for ``patience``, dB.

    Raises:
        ValueError: a number out of range or an unknown choice; the message names the field.

    Example:
        >>> from attnwarp.fit import FitSettings
        >>> FitSettings(kind="3d").opacity_floor
        0.005
        >>> FitSettings(ssim=2)
        Traceback (most recent call last):
        ValueError: ssim: got 2, expected a number in [0, 1]
    """

    kind: Kind = "2d"
    iterations: Count = 7000
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    sh_degree: Annotated[int, Range(0, 3)] = 3
    sh_every: Interval = 0.14
    lr_means: Weight = 1.6e-4
    lr_means_final: Weight = 1.6e-6
    lr_dc: Weight = 2.5e-3
    lr_rest: Weight = 1.25e-4
    lr_opacity: Weight = 5e-2
    lr_scales: Weight = 5e-3
    lr_quats: Weight = 1e-3
    ssim: Share = 0.2
    normal: Weight | None = None
    distortion: Weight | None = None
    normal_from: Share = 0.23
    distortion_from: Share = 0.1
    background: Background = "auto"
    densify: bool = True
    densify_from: Share = 0.07
    densify_every: Interval = 0.05
    densify_least: Count = 15
    densify_until: Share = 0.5
    grow_gradient: Weight = 2e-4
    max_splats: Count | None = None
    prune_opacity: Share | None = None
    prune_scale: Annotated[float, Range(1e-6)] = 0.1
    reset_every: Interval = 0.1
    reset_least: Count = 3000
    reset_opacity: Annotated[float, Range(1e-6, 1 - 1e-6)] = 0.01  # keeps the logit finite
    antialiased: bool = False
    near: Annotated[float, Range(1e-9)] = 0.01
    sky: Sky = True
    exposure: bool = False
    evaluate_every: Count = 500
    patience: Count | None = None
    min_gain: Weight = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.antialiased and self.kind == "2d":
            raise ValueError(
                "antialiased: applies to kind '3d' only; 2D splats have a screen filter instead"
            )

    @property
    def normal_weight(self) -> float:
        """``normal``, or its default for the kind."""
        return (0.05 if self.kind == "2d" else 0.0) if self.normal is None else self.normal

    @property
    def distortion_weight(self) -> float:
        """``distortion``, or its default for the kind."""
        return (0.01 if self.kind == "2d" else 0.0) if self.distortion is None else self.distortion

    @property
    def opacity_floor(self) -> float:
        """``prune_opacity``, or its default for the kind."""
        return (
            (0.05 if self.kind == "2d" else 0.005)
            if self.prune_opacity is None
            else self.prune_opacity
        )
