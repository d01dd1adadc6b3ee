"""Settings and presets of attention warping."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from attnwarp import check
from attnwarp.editing.layers import Kind
from attnwarp.editing.schedule import Grid
from attnwarp.methods.settings import STABLE_DIFFUSION, MethodSettings, checked_start
from attnwarp.settings import Count, Number, Share, Weight
from attnwarp.warp.settings import PRESETS as WARPS
from attnwarp.warp.settings import WarpSettings

MOST_VIEWS = 40
"""Number of views per stage in the paper."""


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
        batch: number of target views edited together; on a CPU the threads divide them among
            themselves (:mod:`attnwarp.editing.lanes`). Results depend on it in the last bits.
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
            which it falls to 0; "constant"; or "by_kind": constant for self-attention, falling to
            0 within the first third for cross-attention, and "late" for all else.
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
            "lifted": all of "all", after each splat's colour moved by the change that its pixels
            ask for (:meth:`attnwarp.methods.tuning.Tuning.lift`).
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
    decay: Literal["linear", "late", "constant", "by_kind"] = "linear"
    kinds: tuple[Kind, ...] | None = None
    blocks: tuple[int | str, ...] | None = None
    feature_steps: tuple[float, float] = (0.0, 1.0)
    branches: tuple[str, ...] | None = None
    feature_type: Literal["float32", "float16", "bfloat16"] = "float32"
    training: Literal["all", "stage", "modulo", "lifted"] = "all"
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

PRESETS: dict[str, MethodSettings] = {
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
        suffix=STABLE_DIFFUSION["suffix"],
        negative_prompt=STABLE_DIFFUSION["negative_prompt"],
    ),
    "extended": AttentionWarpingSettings(
        noise="surface",
        warp=WARPS["tolerant"],
        unseen="attend",
        a0=1.0,
        decay="by_kind",
        training="lifted",
        iterations=50,
        color_rate=1.0,
    ),
}
"""Presets by name, the default first; see :data:`attnwarp.methods.PRESETS`."""
