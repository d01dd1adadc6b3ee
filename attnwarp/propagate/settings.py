"""The choices that Algorithm 1 is made of, and presets: the paper's text, its released code, and
what measures right.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, get_args

from attnwarp import check
from attnwarp.editing.attention import Block, Kind
from attnwarp.editing.schedule import PUBLISHED_STEPS
from attnwarp.warp import WarpSettings, settings

Method = Literal["warp", "each view alone"]
Noise = Literal["shared", "fresh", "surface"]
Latents = Literal["random", "inversion"]
StartPicture = Literal["render", "original"]
EstimateIn = Literal["latents", "picture"]
DepthFrom = Literal["frozen", "current"]
Decay = Literal["linear", "constant"]
FeatureType = Literal["float32", "float16"]
Composite = Literal["none", "black", "original"]
Training = Literal["all", "stage", "modulo"]
Background = Literal["black", "white", "random"]
Detail = Literal["change", "none"]
PsnrViews = Literal["all", "before_last_stage"]

MOST_VIEWS = 40
"""Views of a stage in the paper."""

_CHOICES: dict[str, Any] = {
    "method": Method,
    "noise": Noise,
    "latents": Latents,
    "start_picture": StartPicture,
    "estimate_in": EstimateIn,
    "depth_from": DepthFrom,
    "decay": Decay,
    "feature_type": FeatureType,
    "composite": Composite,
    "training": Training,
    "background": Background,
    "detail": Detail,
    "psnr_views": PsnrViews,
}


@dataclass(frozen=True)
class PropagateSettings:
    """Every choice of :func:`attnwarp.propagate.propagate`; the defaults are ``corrected``.

    Args:
        method: "warp" carries the source's features into each view; "each view alone" edits each
            view by itself, with all else equal: the control.
        stages: of editing and tuning.
        views_per_stage: new views that a stage edits. None: an equal share of the views, at most
            40. A stage for which no view is left is dropped.
        seed: of the subsets, the noise, and the order of tuning.
        size: longest side in px at which the editor works; None for the cameras' own. Sides are
            rounded to what the editor takes.
        steps: of denoising.
        noise: "shared" by source and targets, pixel by pixel; "fresh" for each view; or "surface":
            a point of the surface has the same noise in every view
            (:mod:`attnwarp.propagate.noise`).
        latents: what a view's edit starts from: "random" ones, or the DDIM "inversion" of its
            picture before the edit, without guidance, of an editor that is guided by depth. Each
            view then has a start of its own, so ``noise`` stays "shared" and ``start`` None.
        source_prompt: of the inversion: what the scene shows; None for the instruction.
        start: (lowest, highest) timestep of Stable Diffusion, of which one is drawn for all views,
            to start from in place of pure noise. On the editor's own schedule it becomes the step
            that leaves as much of the picture
            (:func:`attnwarp.editing.schedule.steps_as_published`).
        start_picture: what is noised to ``start``: the current "render" (IGS2GS) or the "original".
        text_guidance: s_T of the first stage; None for the editor's own.
        guidance_drop: what each further stage takes off ``text_guidance``, which may fall to 0 and
            not below.
        source_text_guidance: s_T of the source; None for the first stage's.
        batch: target views that go through the network together. Another batch gives other bits.
        warp: correspondences and masks, :class:`attnwarp.warp.WarpSettings`.
        mask: False injects wherever the target has a depth (the ablation "no M").
        sources: views whose features are recorded and warped. Those after the first are edited in
            a chain outward from it, each covered by those before; a target's pixel takes the source
            that sees it best (:mod:`attnwarp.propagate.sight`).
        chain_coverage: share of its surface that the sources so far must see of the next one. The
            view they see least of is taken among those.
        confidence: weigh the features by how well the source sees the surface (foreshortening and
            the margin of depth agreement) instead of by the mask alone.
        estimate: weight at the first step of the source's warped estimate of the clean latents, in
            the target's estimate. It falls to 0 at ``estimate_until``. 0 leaves it out.
        estimate_until: share of the steps after which it is left out.
        estimate_in: where it is warped: as "latents", whose cells keep the source's order of pixels
            inside, or as a "picture", which is decoded, warped pixel by pixel and encoded again.
            In each step of a view the editor then decodes the view and each source, and encodes
            twice.
        estimate_margin: what of the source on either side of a depth edge is not warped as its
            estimate, since pixels there mix near and far; a share of its shorter side, rounded to
            whole pixels.
        depth_from: the model before the edit ("frozen") or as tuned so far ("current").
        a0: weight of the injected features at the first step.
        decay: "linear", a_t = a0 (T - t) / T, or "constant".
        fractions, kinds, blocks: layers, :func:`attnwarp.editing.attention.choose_layers`.
        feature_steps: (from, until) shares of the steps whose features are recorded and injected.
            The others leave every view its own: [0, 0.5] halves the memory.
        branches: guidance branches that get features. None: text and image of InstructPix2Pix,
            both of a ControlNet.
        feature_type: of the recorded features; float16 halves their memory and rounds.
        composite: what stands outside the segments, where they are given: the edit ("none"),
            "black", or the "original" picture.
        composite_blur: sigma in px that the segments are blurred with before compositing.
        iterations: of tuning in each stage, one view each.
        training: views that a stage tunes on. "all": the source and everything edited so far.
            "stage": the stage's views. "modulo": view ``step % n`` of the stage's n views, but the
            source at every tenth step; of 40 views 4 are then never visited (the released code).
        l1, perceptual, normal, distortion: weights of the losses.
        perceptual_encoder: :func:`attnwarp.encoders.load_encoder`'s name of the perceptual loss.
        color_rate: factor of the published learning rates of colours. Adam moves a coefficient by
            at most its rate in a step: at 1, 900 steps change a colour by at most 0.63.
        geometry_rate: factor of the learning rates of centres, scales, rotations and opacities; 0
            tunes colours alone.
        background: behind the splats while tuning.
        detail: where the editor works at a smaller size than the pictures', "change" adds the
            edit's change, enlarged, to the full picture; "none" tunes at the editor's size.
        psnr_views: views that Edit PSNR counts; "before_last_stage" as the released code has it.

    Raises:
        ValueError: an unknown choice or a number out of range; the message names the field.

    Example:
        >>> from dataclasses import replace
        >>> from attnwarp.propagate import PRESETS, PropagateSettings
        >>> PropagateSettings() == PRESETS["corrected"]
        True
        >>> replace(PropagateSettings(), a0=2)
        Traceback (most recent call last):
        ValueError: a0: got 2, expected a number in [0, 1]
    """

    method: Method = "warp"
    stages: int = 3
    views_per_stage: int | None = None
    seed: int = 0
    size: int | None = None
    steps: int = 20
    noise: Noise = "shared"
    latents: Latents = "random"
    source_prompt: str | None = ""
    start: tuple[int, int] | None = None
    start_picture: StartPicture = "render"
    text_guidance: float | None = None
    guidance_drop: float = 0.0
    source_text_guidance: float | None = None
    batch: int = 4
    warp: WarpSettings = settings.PRESETS["corrected"]
    mask: bool = True
    sources: int = 1
    chain_coverage: float = 0.5
    confidence: bool = False
    estimate: float = 0.0
    estimate_until: float = 0.5
    estimate_in: EstimateIn = "latents"
    estimate_margin: float = 0.0
    depth_from: DepthFrom = "frozen"
    a0: float = 0.9
    decay: Decay = "linear"
    fractions: tuple[float, ...] = (1.0, 0.5)
    kinds: tuple[Kind, ...] = ("self", "cross")
    blocks: tuple[Block, ...] = ("up",)
    feature_steps: tuple[float, float] = (0.0, 1.0)
    branches: tuple[str, ...] | None = None
    feature_type: FeatureType = "float32"
    composite: Composite = "original"
    composite_blur: float = 0.0
    iterations: int = 300
    training: Training = "all"
    l1: float = 1.0
    perceptual: float = 1.0
    normal: float = 0.05
    distortion: float = 0.01
    perceptual_encoder: str = "perceptual-small"
    color_rate: float = 4.0
    geometry_rate: float = 1.0
    background: Background = "black"
    detail: Detail = "change"
    psnr_views: PsnrViews = "all"

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            check.one_of(getattr(self, name), get_args(choices), name)
        for name in ("mask", "confidence"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected true or false")
        check.text(self.perceptual_encoder, "perceptual_encoder")
        self._check_latents()
        if not isinstance(self.warp, WarpSettings):
            raise ValueError(f"warp: got {self.warp!r}, expected WarpSettings")
        for name in ("fractions", "kinds", "blocks", "feature_steps", "branches", "start"):
            value = getattr(self, name)
            if isinstance(value, list):
                object.__setattr__(self, name, tuple(value))
            elif not isinstance(value, tuple) and not (
                value is None and name in ("branches", "start")
            ):
                raise ValueError(f"{name}: got {value!r}, expected a list")
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if value is not None or name not in _OPTIONAL:
                value = check.number(value, low, high, name, whole=name in _WHOLE)
                object.__setattr__(self, name, value)
        object.__setattr__(self, "start", _checked_start(self.start))
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
        if last is not None and last < -1e-9:  # 0.3 - 3 * 0.1 is not below 0
            raise ValueError(
                f"text_guidance, guidance_drop: got {self.text_guidance:g} and"
                f" {self.guidance_drop:g}, so stage {self.stages} has {last:g}, expected at least 0"
            )

    def _check_latents(self) -> None:
        if self.source_prompt is not None:
            check.text(self.source_prompt, "source_prompt")
        if self.latents == "random":
            if self.source_prompt != "":
                raise ValueError(
                    f"source_prompt: got {self.source_prompt!r} with random latents; set latents to"
                    " 'inversion', which reads it, or leave it out"
                )
            return
        for name, value, plain in (("noise", self.noise, "shared"), ("start", self.start, None)):
            if value != plain:
                raise ValueError(
                    f"{name}: got {value!r} with latents 'inversion', from which each view has its"
                    f" own start; set {name} to {plain!r}, or latents to 'random'"
                )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values in the order of the fields; equal settings give equal dictionaries.

        Fields that came after the first edits are left out at their defaults, so that folders and
        studies of before are still those of the same settings.
        """
        values = asdict(self)
        for name in _LATER:
            if values[name] == getattr(type(self), name):
                del values[name]
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> PropagateSettings:
        """The settings :meth:`to_dict` wrote. Fields left out take the default.

        Raises:
            ValueError: a key that is no field, or a value out of range.
        """
        known = [field.name for field in fields(cls)]
        for key in data:
            check.one_of(key, known, "setting")
        values = dict(data)
        if isinstance(values.get("warp"), dict):
            values["warp"] = WarpSettings.from_dict(values["warp"])
        return cls(**values)

    def guidance(self, stage: int) -> float | None:
        """s_T of a stage, counted from 0; None for the editor's own.

        Example:
            >>> from attnwarp.propagate import PRESETS
            >>> [PRESETS["released"].guidance(stage) for stage in range(3)]
            [12.5, 11.0, 9.5]
        """
        if self.text_guidance is None:
            return None
        return self.text_guidance - self.guidance_drop * stage

    def feature_range(self) -> range:
        """Numbers of the steps whose features are recorded and injected, from 0.

        Example:
            >>> from attnwarp.propagate import preset
            >>> preset("corrected", steps=20, feature_steps=(0.0, 0.3)).feature_range()
            range(0, 6)
        """
        # 0.1 * 30 is above 3 in floats: a share that names a step exactly means that step.
        first, end = (math.ceil(share * self.steps - 1e-9) for share in self.feature_steps)
        return range(first, end)


_LATER = ("latents", "source_prompt", "feature_steps", "estimate_in", "estimate_margin")
_WHOLE = {
    "stages", "views_per_stage", "seed", "size", "steps", "batch", "sources", "iterations",
}  # fmt: skip
_OPTIONAL = {"views_per_stage", "size", "text_guidance", "source_text_guidance"}
_LIMITS: dict[str, tuple[float, float]] = {
    "stages": (1, math.inf),
    "views_per_stage": (1, math.inf),
    "seed": (0, 2**62),
    "size": (1, math.inf),
    "steps": (1, 1000),
    "text_guidance": (0, math.inf),
    "guidance_drop": (0, math.inf),
    "source_text_guidance": (0, math.inf),
    "batch": (1, math.inf),
    "sources": (1, math.inf),
    "chain_coverage": (0, 1),
    "estimate": (0, 1),
    "estimate_until": (0, math.inf),
    "estimate_margin": (0, 1),
    "a0": (0, 1),
    "composite_blur": (0, 1000),
    "iterations": (0, math.inf),
    "l1": (0, math.inf),
    "perceptual": (0, math.inf),
    "normal": (0, math.inf),
    "distortion": (0, math.inf),
    "color_rate": (0, math.inf),
    "geometry_rate": (0, math.inf),
}


def _checked_start(start: tuple[int, int] | None) -> tuple[int, int] | None:
    if start is None:
        return None
    last = PUBLISHED_STEPS - 1
    right = len(start) == 2 and all(check.is_number(t, whole=True) for t in start)
    if not right or not 0 <= start[0] <= start[1] <= last:
        raise ValueError(
            f"start: got {list(start)}, expected [lowest, highest] timestep of Stable Diffusion, in"
            f" [0, {last}]"
        )
    return int(start[0]), int(start[1])


def _checked_shares(shares: tuple[float, float]) -> tuple[float, float]:
    right = len(shares) == 2 and all(check.is_number(share) for share in shares)
    if not right or not 0 <= shares[0] < shares[1] <= 1:
        raise ValueError(
            f"feature_steps: got {list(shares)}, expected [from, until] shares of the steps, with"
            " 0 <= from < until <= 1"
        )
    first, last = (check.number(share, 0, 1, "feature_steps") for share in shares)
    return first, last


_RELEASED = PropagateSettings(
    views_per_stage=MOST_VIEWS,
    start=(700, 980),
    text_guidance=12.5,
    guidance_drop=1.5,
    warp=settings.PRESETS["released"],
    depth_from="current",
    composite_blur=1.5,
    training="modulo",
    color_rate=1.0,
    background="random",
    psnr_views="before_last_stage",
)

PRESETS: dict[str, PropagateSettings] = {
    "paper": PropagateSettings(
        views_per_stage=MOST_VIEWS,
        warp=settings.PRESETS["paper"],
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
        text_guidance=12.5,
        guidance_drop=0.0,
        source_text_guidance=7.5,
    ),
    "corrected": PropagateSettings(),
    "extended": PropagateSettings(
        sources=4,
        noise="surface",
        estimate=1.0,
        estimate_until=2.0,
        estimate_in="picture",
        estimate_margin=1 / 64,
    ),
}
"""Sets of choices, each with the warp of that name (:data:`attnwarp.warp.PRESETS`).

``paper``: the text. Each stage draws 40 views and tunes on these alone, depth comes from the scene
as it stands, and pictures are black outside the segments. What the text leaves open is as in
``corrected``.

``released``: the authors' code with InstructPix2Pix. One timestep in [700, 980] and one noise for
all views, s_T = 12.5 - 1.5 stage, depth of the current model, tuning by the step's number modulo
the stage's views, segments blurred with sigma 1.5. ``released-controlnet``: the same with a
ControlNet, where each view draws fresh noise, and the source has s_T 7.5 and the targets 12.5.

``corrected``: the default. Noise is shared, depth is that of the model before the edit, and a stage
tunes on everything edited so far, with larger steps of the colours.

``extended``: ``corrected`` with ideas beyond the paper: further sources, noise that sticks to the
surface, and the sources' clean pictures, with a weight that falls from 1 to a half, but for their
depth edges. The study ``beyond`` has each alone and all together.
"""


def preset(name: str, **changes: Any) -> PropagateSettings:
    """A preset, with some of its fields changed.

    Args:
        name: a key of :data:`PRESETS`.
        changes: fields of :class:`PropagateSettings`; ``warp.NAME`` is a field of its warp.

    Raises:
        ValueError: an unknown preset or field, or a value out of range; the message names it.

    Example:
        >>> from attnwarp.propagate import preset
        >>> preset("corrected", stages=1, **{"warp.opaque": 0.9}).warp.opaque
        0.9
    """
    check.one_of(name, list(PRESETS), "preset")
    values = PRESETS[name].to_dict()
    for key, value in changes.items():
        if key.startswith("warp."):
            if not isinstance(values["warp"], dict):
                raise ValueError(f"warp: got {values['warp']!r}, expected its fields by name")
            values["warp"] = {**values["warp"], key.removeprefix("warp."): value}
        else:
            values[key] = value
    return PropagateSettings.from_dict(values)
