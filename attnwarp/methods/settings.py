"""Settings of each method, and presets: the published settings and the recommended ones."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from attnwarp import check
from attnwarp.editing.layers import Kind
from attnwarp.editing.schedule import PUBLISHED_STEPS, Grid
from attnwarp.errors import Named
from attnwarp.settings import Count, Number, Range, Seed, Settings, Share, Weight
from attnwarp.warp.settings import PRESETS as WARPS
from attnwarp.warp.settings import WarpSettings

Noise = Literal["fresh", "shared"]
Latents = Literal["inversion", "random"]
Background = Literal["black", "white", "random"]
Composite = Literal["none", "black", "original"]

Steps = Annotated[int, Range(1, 1000)]

MOST_VIEWS = 40
"""Number of views per stage in the paper."""


@dataclass(frozen=True)
class MethodSettings(Settings):
    """Settings shared by all methods. Each method has a subclass with its published numbers.

    Timesteps are Stable Diffusion's, in [0, 999]. On the editor's schedule each timestep becomes
    the step that leaves the same share of the picture
    (:meth:`attnwarp.editing.schedule.Schedule.published`).

    Args:
        seed: seed of all random numbers.
        size: longest side in px at which the editor works; None for the cameras' size. Sides are
            rounded to multiples that the editor takes.
        steps: number of denoising steps.
        noise: "fresh" for each edit, as published, or "shared" by all edits of a run. Shared noise
            implies one starting timestep for all views of a round.
        text_guidance: s_T of InstructPix2Pix, or the guidance of a ControlNet; None for the
            editor's default.
        image_guidance: s_I of InstructPix2Pix; None for the editor's default.
        iterations: number of tuning iterations, one view each: in total, or per stage of attention
            warping.
        l1, ssim, perceptual, normal, distortion: weights of the losses; that of ssim multiplies
            1 - SSIM, the weight of distortion the form "ordered" of
            :func:`attnwarp.losses.depth_distortion`.
        perceptual_encoder: name of the perceptual loss, for :func:`attnwarp.encoders.load_encoder`.
        color_rate: factor of the published learning rates of the colours.
        background: colour behind the splats while tuning.
        composite: picture outside the segments, if segments are given: the edit ("none"), "black",
            or the "original" picture.
        composite_blur: sigma in px of the segments' blur before compositing.

    Raises:
        ValueError: an unknown choice or a number out of range; the message names the field.

    Example:
        >>> from attnwarp.methods import IGS2GSSettings
        >>> IGS2GSSettings().changed(noise="shared", steps=10).to_dict()["noise"]
        'shared'
    """

    seed: Seed = 0
    size: Count | None = None
    steps: Steps = 20
    noise: Noise = "fresh"
    text_guidance: Weight | None = None
    image_guidance: Weight | None = None
    iterations: Number = 1000
    l1: Weight = 1.0
    ssim: Weight = 0.2
    perceptual: Weight = 0.0
    normal: Weight = 0.0
    distortion: Weight = 0.0
    perceptual_encoder: str = "perceptual-small"
    color_rate: Weight = 1.0
    background: Background = "black"
    composite: Composite = "original"
    composite_blur: Annotated[float, Range(0, 1000)] = 0.0


LAST_STEP = PUBLISHED_STEPS - 1


def checked_start(start: tuple[int, int] | None) -> tuple[int, int] | None:
    """Check ``start``: a (lowest, highest) timestep of Stable Diffusion, or None."""
    if start is None:
        return None
    right = len(start) == 2 and all(check.is_number(t, whole=True) for t in start)
    if not right or not 0 <= start[0] <= start[1] <= LAST_STEP:
        raise ValueError(
            f"start: got {list(start)}, expected [lowest, highest] timestep of Stable Diffusion, in"
            f" [0, {LAST_STEP}]"
        )
    return int(start[0]), int(start[1])


def _checked_shares(shares: tuple[float, float]) -> tuple[float, float]:
    right = len(shares) == 2 and all(check.is_number(share) for share in shares)
    if not right or not 0 <= shares[0] < shares[1] <= 1:
        raise ValueError(
            f"feature_steps: got {list(shares)}, expected [from, until] shares of the steps, with"
            " 0 <= from < until <= 1"
        )
    return float(shares[0]), float(shares[1])


@dataclass(frozen=True)
class AttentionWarpingSettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.attention_warping`; the defaults are ``corrected``.

    Args:
        stages: number of stages of editing and tuning.
        views_per_stage: number of new views per stage. None: an equal share of the views, at most
            40. A stage without remaining views is dropped.
        fill_last_stage: True fills a last stage that is short of views with views edited before,
            at random.
        noise: "shared" by source and targets, pixel by pixel; "fresh" for each view; or "surface":
            a point of the surface has the same noise in every view
            (:mod:`attnwarp.methods.noise`).
        latents: initial latents of a view's edit: "random", or the DDIM "inversion" of its
            ``start_picture``, without guidance, by an editor guided by depth. Inverted latents
            differ per view, so ``noise`` stays "shared" and ``start`` None. "by_stage": random in
            the first stage, inversion in later stages.
        source_prompt: prompt of the inversion, which describes the scene; None for the
            instruction.
        start: (lowest, highest) timestep of Stable Diffusion; one timestep in this range is drawn
            for all views and replaces pure noise. On the editor's schedule it becomes the step
            that leaves the same share of the picture
            (:meth:`attnwarp.editing.schedule.Schedule.published`).
        grid: grid of the steps below ``start``, :data:`attnwarp.editing.schedule.Grid`.
        start_picture: picture to noise to ``start`` or to invert: the "original", the current
            "render" (IGS2GS), or "by_stage": the original in the first stage, the render later.
        suffix: suffix of the instruction.
        negative_prompt: negative prompt of a ControlNet's unconditional branch; None for the
            editor's default.
        text_guidance: s_T of the first stage; None for the editor's default.
        guidance_drop: decrease of ``text_guidance`` per further stage; the result must not fall
            below 0.
        source_text_guidance: s_T of the source; None for the first stage's.
        batch: number of target views per network pass. Results depend on it in the last bits.
        warp: correspondences and masks, :class:`attnwarp.warp.WarpSettings`.
        mask: True injects only inside M; False wherever the target has a depth (ablation "no M").
        outside: features of points that project outside the source: the "border"'s, or "zeros", as
            padding gives them. With a mask such points take no features.
        unseen: editing of marked pixels that no warp reaches: "free", as the editor chooses, or
            "attend", with attention to the source's edit (:mod:`attnwarp.methods.unseen`).
        reference: the source's edit as a further picture that the editor sees beside the view's
            own, if it takes any: "plain" as it is, or "warped" to the view, whose own picture stays
            where the source sees nothing.
        depth_from: model of the depth: before the edit ("frozen") or as tuned so far ("current").
        a0: weight of the injected features at the first step. 0 records nothing and edits each view
            alone, with all else equal: the control.
        decay: "linear", a_t = a0 (T - t) / T; "late", a0 until the last third of the steps, in
            which it falls to 0; or "constant".
        kinds: kinds of features that are warped, such as ["self"]; None for all outputs of
            attention. ["key", "value"] warps a transformer's keys, before positions turn them, and
            its values.
        blocks: numbers of the editor's blocks whose features are warped, or names of its sets of
            blocks, such as ["double"]; None for all it offers, such as the up-sampling blocks of a
            UNet at the latents' size and at half of it.
        feature_steps: (from, until) shares of the steps whose features are recorded and injected.
            In other steps views keep their features: [0, 0.5] halves the memory.
        branches: guidance branches that get features. None: text and image of InstructPix2Pix,
            both of a ControlNet.
        feature_type: dtype of the recorded features. float16 halves their memory and rounds;
            bfloat16 rounds eight times as coarsely and has float32's range.
        training: views that a stage tunes on. "all": the source and everything edited so far.
            "stage": the stage's views. "modulo": view ``step % n`` of the stage's n views, but the
            source at every tenth step; 4 of 40 views are then never visited (the released code).
        color_rate: factor of the published learning rates of colours. Adam moves a coefficient by
            at most its rate in a step: at 1, 900 steps change a colour by at most 0.63.
        psnr_views: views counted in Edit PSNR; the released code uses "before_last_stage".

    Raises:
        ValueError: an unknown choice or a number out of range; the message names the field.

    Example:
        >>> from dataclasses import replace
        >>> from attnwarp.methods import PRESETS, AttentionWarpingSettings
        >>> AttentionWarpingSettings() == PRESETS["attention_warping"]["corrected"]
        True
        >>> replace(AttentionWarpingSettings(), a0=2)
        Traceback (most recent call last):
        ValueError: a0: got 2, expected a number in [0, 1]
    """

    noise: Literal["shared", "fresh", "surface"] = "shared"  # type: ignore[assignment]
    iterations: Number = 300
    ssim: Weight = 0.0
    perceptual: Weight = 1.0
    normal: Weight = 0.05
    distortion: Weight = 0.01
    color_rate: Weight = 4.0
    stages: Count = 3
    views_per_stage: Count | None = None
    fill_last_stage: bool = False
    latents: Literal["random", "inversion", "by_stage"] = "random"
    source_prompt: str | None = ""
    start: tuple[int, int] | None = None
    grid: Grid = "even"
    start_picture: Literal["original", "render", "by_stage"] = "original"
    suffix: str = ""
    negative_prompt: str | None = None
    guidance_drop: Weight = 0.0
    source_text_guidance: Weight | None = None
    batch: Count = 4
    warp: WarpSettings = WARPS["corrected"]
    mask: bool = True
    outside: Literal["border", "zeros"] = "border"
    unseen: Literal["free", "attend"] = "free"
    reference: Literal["none", "plain", "warped"] = "none"
    depth_from: Literal["frozen", "current"] = "frozen"
    a0: Share = 0.9
    decay: Literal["linear", "late", "constant"] = "linear"
    kinds: tuple[Kind, ...] | None = None
    blocks: tuple[int | str, ...] | None = None
    feature_steps: tuple[float, float] = (0.0, 1.0)
    branches: tuple[str, ...] | None = None
    feature_type: Literal["float32", "float16", "bfloat16"] = "float32"
    training: Literal["all", "stage", "modulo"] = "all"
    psnr_views: Literal["all", "before_last_stage"] = "all"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_latents()
        object.__setattr__(self, "start", checked_start(self.start))
        object.__setattr__(self, "feature_steps", _checked_shares(self.feature_steps))
        if not self.feature_range():
            raise ValueError(
                f"feature_steps: got {list(self.feature_steps)}, in which none of {self.steps}"
                " steps begins; widen it, or take more steps"
            )
        if self.guidance_drop > 0 and self.text_guidance is None:
            raise ValueError(
                f"guidance_drop: got {self.guidance_drop:g} without text_guidance, which it is"
                " taken off; give text_guidance too, or set guidance_drop to 0"
            )
        last = self.guidance(self.stages - 1)
        if last is not None and last < -1e-9:  # tolerance: 0.3 - 3 * 0.1 is not below 0
            raise ValueError(
                f"text_guidance, guidance_drop: got {self.text_guidance:g} and"
                f" {self.guidance_drop:g}, so stage {self.stages} has {last:g}, expected at least 0"
            )

    def _check_latents(self) -> None:
        if self.latents == "random":
            if self.source_prompt != "":
                raise ValueError(
                    f"source_prompt: got {self.source_prompt!r} with random latents; set latents to"
                    " 'inversion', which reads it, or leave it out"
                )
            return
        plain: Any
        for name, value, plain in (("noise", self.noise, "shared"), ("start", self.start, None)):
            if name == "noise" and self.latents == "by_stage":  # the first stage starts from it
                continue
            if value != plain:
                raise ValueError(
                    f"{name}: got {value!r} with latents {self.latents!r}, from which each view has"
                    f" its own start; set {name} to {plain!r}, or latents to 'random'"
                )

    def guidance(self, stage: int) -> float | None:
        """Compute s_T of a stage, counted from 0; None for the editor's default.

        Example:
            >>> from attnwarp.methods import PRESETS
            >>> [PRESETS["attention_warping"]["released"].guidance(stage) for stage in range(3)]
            [12.5, 11.0, 9.5]
        """
        if self.text_guidance is None:
            return None
        return self.text_guidance - self.guidance_drop * stage

    def inverts(self, stage: int) -> bool:
        """Return True if the views of a stage, counted from 0, start from inverted latents.

        Example:
            >>> from attnwarp.methods import PRESETS
            >>> released = PRESETS["attention_warping"]["released-controlnet"]
            >>> [released.inverts(stage) for stage in range(3)]
            [False, True, True]
        """
        return self.latents == "inversion" or (self.latents == "by_stage" and stage > 0)

    def feature_range(self) -> range:
        """Compute the numbers, from 0, of the steps whose features are recorded and injected.

        Example:
            >>> from attnwarp.methods import preset
            >>> preset("attention_warping", steps=20, feature_steps=(0.0, 0.3)).feature_range()
            range(0, 6)
        """
        # 0.1 * 30 exceeds 3 in floats; a share equal to a step boundary must select that step.
        first, end = (math.ceil(share * self.steps - 1e-9) for share in self.feature_steps)
        return range(first, end)


@dataclass(frozen=True)
class ByViewSettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.by_view`.

    The losses, rates and iterations equal those of
    :class:`attnwarp.methods.AttentionWarpingSettings`, so the two methods differ only in the edits.

    Args:
        start: (lowest, highest) range of the starting timestep, drawn for each edit; None for pure
            noise.
        batch: number of views per network pass; 1 if ``start`` is given and the noise is fresh.
            Results depend on it in the last bits.

    Example:
        >>> from attnwarp.methods import ByViewSettings
        >>> ByViewSettings(batch=0)
        Traceback (most recent call last):
        ValueError: batch: got 0, expected a whole number >= 1
    """

    iterations: Number = 900
    ssim: Weight = 0.0
    perceptual: Weight = 1.0
    normal: Weight = 0.05
    distortion: Weight = 0.01
    color_rate: Weight = 4.0
    start: tuple[int, int] | None = None
    batch: Count = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "start", checked_start(self.start))


@dataclass(frozen=True)
class IGS2GSSettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.igs2gs`.

    Args:
        every: number of tuning iterations between two edits of all views.
        start: (lowest, highest) range of the starting timestep, drawn for each edit.
        grid: grid of the steps below the start, :data:`attnwarp.editing.schedule.Grid`.

    Example:
        >>> from attnwarp.methods import IGS2GSSettings
        >>> settings = IGS2GSSettings(iterations=3000)
        >>> settings.start, settings.iterations / settings.every  # a full round and a part
        ((700, 980), 1.2)
    """

    iterations: Number = 7500
    every: Count = 2500
    start: tuple[int, int] = (700, 980)
    grid: Grid = "even"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "start", checked_start(self.start))


@dataclass(frozen=True)
class DGESettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.dge`.

    Args:
        every: number of tuning iterations between two draws and edits of views.
        views: number of views per round; all views if there are fewer.
        batch: number of neighbouring views that share a key view.
        starts: starting timestep of each round; the last also serves all further rounds.
        grid: grid of the steps below the start, :data:`attnwarp.editing.schedule.Grid`.
        plain_below: timestep below which every view uses plain self-attention.
        epipolar: distance from the epipolar line, in px of the layer, beyond which matches are
            excluded; None excludes none.

    Example:
        >>> from attnwarp.methods import DGESettings
        >>> DGESettings().starts  # nearly pure noise first, small changes after
        (998, 299)
    """

    iterations: Number = 1500
    l1: Weight = 10.0
    ssim: Weight = 0.0
    perceptual: Weight = 10.0
    every: Count = 500
    views: Count = 20
    batch: Count = 5
    starts: tuple[int, ...] = (998, 299)
    grid: Grid = "even"
    plain_below: Annotated[int, Range(0, 1000)] = 100
    epipolar: Weight | None = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        right = all(check.is_number(t, whole=True) and 0 <= t <= LAST_STEP for t in self.starts)
        if not self.starts or not right:
            raise ValueError(
                f"starts: got {self.starts!r}, expected timesteps of Stable Diffusion, in"
                f" [0, {LAST_STEP}], at least one"
            )


@dataclass(frozen=True)
class GaussCtrlSettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.gaussctrl`.

    Args:
        views: number of edited views: an equal share of each contiguous part of the views, at
            random; all views if there are fewer.
        references: number of parts of the views; each part gives one reference view.
        self_share: weight of a view's own keys in the UNet's self-attention; the rest is shared
            equally by the reference views.
        control_share: ``self_share`` for the ControlNet; None keeps its attention unchanged.
        latents: initial latents of an edit: DDIM "inversion" of the render, or "random".
        source_prompt: prompt of the inversion; None for the instruction.
        suffix: suffix of the instruction.
        negative_prompt: negative prompt of the unconditional branch; None for the editor's default.
        batch: number of views per network pass, besides the reference views.

    Example:
        >>> from attnwarp.methods import GaussCtrlSettings
        >>> GaussCtrlSettings().self_share
        0.6
    """

    views: Count = 40
    references: Count = 4
    self_share: Share = 0.6
    control_share: Share | None = None
    latents: Latents = "inversion"
    source_prompt: str | None = ""
    suffix: str = ""
    negative_prompt: str | None = None
    batch: Count = 5


@dataclass(frozen=True)
class CarriedSettings(ByViewSettings):
    """Settings shared by the methods that carry edits along warps of their own.

    Args:
        warp: correspondences and masks, :class:`attnwarp.warp.WarpSettings`.
    """

    warp: WarpSettings = WARPS["corrected"]


@dataclass(frozen=True)
class SourceSettings(CarriedSettings):
    """Settings shared by those of them that give one view, the source, a part of its own."""


@dataclass(frozen=True)
class CorrespondingSettings(SourceSettings):
    """Settings of :func:`attnwarp.methods.corresponding`.

    Args:
        self_share: weight of a view's own keys in its self-attention; the rest is attention to the
            source view, which then is in every batch. Below 1 the editor must be Stable
            Diffusion's.
        batch: number of views per network pass, whose tokens are mixed.

    Example:
        >>> from attnwarp.methods import preset
        >>> preset("corresponding", "released").self_share
        0.7
    """

    batch: Count = 40
    self_share: Share = 1.0


@dataclass(frozen=True)
class WarpedReferenceSettings(SourceSettings):
    """Settings of :func:`attnwarp.methods.warped_reference`.

    Args:
        start: (lowest, highest) range of the timestep to which start pictures are noised; one is
            drawn for all views. The source starts from pure noise.

    Example:
        >>> from attnwarp.methods import WarpedReferenceSettings
        >>> WarpedReferenceSettings(start=None)
        Traceback (most recent call last):
        ValueError: start: got None, but views begin at pictures; give [lowest, highest]
    """

    start: tuple[int, int] | None = (700, 700)

    def __post_init__(self) -> None:
        super().__post_init__()
        _needs_start(self.start)


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
        _needs_start(self.start)


@dataclass(frozen=True)
class GuidedSettings(SourceSettings):
    """Settings of :func:`attnwarp.methods.guided`.

    Args:
        batch: unused; views are edited one at a time.
        partners: number of views edited before that guide a view.
        below: timestep of Stable Diffusion below which steps are guided.
        forward: weight of the gradient through the network; 0 takes none.
        backward: number of steps of the predicted picture at each guided step.
        rate: share of Polyak's step that each of them takes.
        points, patches: largest numbers of matched points and patches.
        patch: side of the patches in px of a picture of 512 px; others are scaled alike.
        patch_weight: weight of the patches' perceptual distance against L1.

    Example:
        >>> from attnwarp.methods import GuidedSettings
        >>> GuidedSettings(below=1000)
        Traceback (most recent call last):
        ValueError: below: got 1000, expected a whole number in [0, 999]
    """

    partners: Count = 2
    below: Annotated[int, Range(0, LAST_STEP)] = 700
    forward: Weight = 0.1
    backward: Number = 3
    rate: Weight = 0.3
    points: Count = 50_000
    patches: Count = 1_500
    patch: Count = 64
    patch_weight: Weight = 2.0


def _needs_start(start: tuple[int, int] | None) -> None:
    if start is None:
        raise ValueError("start: got None, but views begin at pictures; give [lowest, highest]")


_STABLE_DIFFUSION: dict[str, Any] = {
    "suffix": ", best quality, extremely detailed",
    "negative_prompt": (
        "longbody, lowres, bad anatomy, bad hands, missing fingers, extra digit, fewer digits,"
        " cropped, worst quality, low quality"
    ),
    "text_guidance": 5.0,
}

_IGS2GS = IGS2GSSettings(text_guidance=12.5, image_guidance=1.5, grid="scheduler")

_FUSED = FusedSettings(
    text_guidance=7.5, image_guidance=1.5, grid="scheduler", iterations=1000, normal=0.0,
    distortion=0.0, color_rate=1.0,
)  # fmt: skip

_RELEASED = AttentionWarpingSettings(
    views_per_stage=MOST_VIEWS,
    fill_last_stage=True,
    iterations=960,
    start=(700, 980),
    grid="scheduler",
    start_picture="by_stage",
    text_guidance=12.5,
    guidance_drop=1.5,
    warp=WARPS["released"],
    depth_from="current",
    composite_blur=1.5,
    training="modulo",
    color_rate=1.0,
    background="random",
    psnr_views="before_last_stage",
)

PRESETS: Named[Named[MethodSettings]] = Named({
    "attention_warping": Named({
        "corrected": AttentionWarpingSettings(),
        "paper": AttentionWarpingSettings(
            views_per_stage=MOST_VIEWS,
            warp=WARPS["paper"],
            depth_from="current",
            composite="black",
            training="stage",
            color_rate=1.0,
        ),
        "released": _RELEASED,
        "released-controlnet": replace(
            _RELEASED,
            noise="fresh",
            start=None,
            grid="even",
            latents="by_stage",
            guidance_drop=0.0,
            source_text_guidance=7.5,
            suffix=_STABLE_DIFFUSION["suffix"],
            negative_prompt=_STABLE_DIFFUSION["negative_prompt"],
        ),
        "extended": AttentionWarpingSettings(
            noise="surface",
            warp=WARPS["tolerant"],
            unseen="attend",
            a0=1.0,
            decay="late",
        ),
    }),
    "by_view": Named({"default": ByViewSettings()}),
    "igs2gs": Named({
        "default": IGS2GSSettings(),
        "released": _IGS2GS,
        "improved": replace(_IGS2GS, iterations=3000),
    }),
    "dge": Named({
        "default": DGESettings(),
        "released": DGESettings(text_guidance=7.5, image_guidance=1.5, grid="scheduler"),
    }),
    "gaussctrl": Named({
        "default": GaussCtrlSettings(),
        "paper": GaussCtrlSettings(**_STABLE_DIFFUSION),
        "released": GaussCtrlSettings(control_share=0.0, source_prompt=None, **_STABLE_DIFFUSION),
        "random": GaussCtrlSettings(latents="random", **_STABLE_DIFFUSION),
    }),
    "corresponding": Named({
        "default": CorrespondingSettings(),
        "released": CorrespondingSettings(self_share=0.7, text_guidance=6.0, iterations=1000),
    }),
    "fused": Named({
        "default": FusedSettings(),
        "paper": _FUSED,
        "released": replace(_FUSED, occlusion=False, holes="black", perceptual_scaled=False),
    }),
    "guided": Named({
        "default": GuidedSettings(),
        "paper": GuidedSettings(text_guidance=7.5, image_guidance=1.5),
    }),
    "warped_reference": Named({"default": WarpedReferenceSettings()}),
})  # fmt: skip
"""Settings by the method's name and the preset's name; a method's first preset is its default.

Those of ``attention_warping`` use the warp preset of the same name (:data:`attnwarp.warp.PRESETS`).

``paper``: the text. Each stage draws 40 views and tunes on these alone, depth comes from the
current model, and pictures are black outside the segments. Choices left open by the text are as
in ``corrected``.

``released``: the authors' code with InstructPix2Pix. All views share one timestep T in [700, 980]
and one noise, added at T, while the scheduler has T training steps; the original is noised in the
first stage and the render later. s_T = 12.5 - 1.5 stage, depth of the current model, 40 edits and
960 iterations a stage, tuning by the step's number modulo the stage's views, a short last stage
filled up, segments blurred with sigma 1.5. ``released-controlnet``: the same with a ControlNet;
each view draws fresh noise in the first stage and later starts from the inversion of the current
render; the source has s_T 7.5 and the targets 12.5, prompts end in a suffix and there is a
negative prompt.

``corrected``: the default. Noise is shared, depth comes from the model before the edit, and a stage
tunes on everything edited so far, with larger steps of the colours.

``extended``: ``corrected`` with extensions beyond the paper: noise that sticks to the surface, the
source's features at full weight until the last third of the steps, tolerant masks, and attention to
the source's edit where no warp reaches the marked thing.

``default`` of the other methods: the method with the editor's default guidance and prompts. Their
other presets use the guidance, prompts and step grid published for Stable Diffusion.

``improved`` of ``igs2gs``: 3000 iterations in place of 7500. ``released`` of ``gaussctrl``: the
authors' code, which also aligns the ControlNet's attention, without a share of the view's own
keys, and inverts with the instruction. ``random``: GaussCtrl without its inversion.
"""


def preset(method: str, name: str | None = None, /, **changes: Any) -> Any:
    """Return a method's preset by name, with some fields changed.

    Args:
        method: key of :data:`attnwarp.methods.METHODS`.
        name: name of a preset of the method; the method's default if omitted.
        changes: fields of the method's settings. ``warp`` as a dictionary changes the fields of the
            warp's settings that it names, ``warp.NAME`` one.

    Raises:
        ValueError: an unknown method, preset or field, or a value out of range; the message names
            the argument.

    Example:
        >>> from attnwarp.methods import preset
        >>> preset("igs2gs", "improved", seed=3).iterations
        3000
        >>> preset("attention_warping", stages=1, **{"warp.opaque": 0.9}).warp.opaque
        0.9
        >>> preset("attention_warping", "released", warp={"opaque": 0.9}).warp.depth
        'center'
    """
    check.one_of(method, list(PRESETS), "method")
    named = next(iter(PRESETS[method])) if name is None else name
    check.one_of(named, list(PRESETS[method]), "preset")
    return PRESETS[method][named].changed(**changes)
