"""Settings of the baselines, with the published numbers, and the budget of a run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, TypeVar, get_args

from attnwarp import check
from attnwarp.editing.schedule import PUBLISHED_STEPS

Noise = Literal["fresh", "shared"]
Latents = Literal["inversion", "random"]
Background = Literal["black", "white", "random"]
Detail = Literal["change", "none"]

S = TypeVar("S", bound="BaselineSettings")


@dataclass(frozen=True)
class Budget:
    """Limits of a run. No batch of edits and no iteration of tuning begins beyond them.

    Args:
        seconds: of editing and tuning, over all sittings; None for no limit. A run that was cut
            short by seconds depends on the machine. A method that tunes after all of its edits may
            end before it has tuned.
        network_rows: rows through the UNet; None for no limit. A batch of edits that would go
            beyond does not begin, and the round's tuning is the last.

    Raises:
        ValueError: no number, a negative one, or one that is not finite; rows that are not whole.

    Example:
        >>> from attnwarp.baselines import Budget
        >>> Budget(network_rows=600)
        Budget(seconds=None, network_rows=600)
    """

    seconds: float | None = None
    network_rows: int | None = None

    def __post_init__(self) -> None:
        for name, whole in (("seconds", False), ("network_rows", True)):
            value = getattr(self, name)
            if value is not None:
                value = check.number(value, 0, math.inf, name, whole=whole)
                object.__setattr__(self, name, value)


@dataclass(frozen=True)
class BaselineSettings:
    """What all baselines have. Each has a class of its own with its published numbers.

    Timesteps are Stable Diffusion's, in [0, 999]. On the editor's own schedule each becomes the
    step that leaves as much of the picture
    (:func:`attnwarp.editing.schedule.steps_as_published`).

    Args:
        seed: of everything random.
        size: longest side in px at which the editor works; None for the cameras' own. Sides are
            rounded to what the editor takes.
        steps: of denoising.
        noise: "fresh" for each edit, as published, or "shared" by all edits of a run. Shared noise
            comes with one timestep to start from for all views of a round.
        text_guidance: s_T of InstructPix2Pix, or the guidance of a ControlNet; None for the
            editor's own.
        image_guidance: s_I of InstructPix2Pix; None for the editor's own.
        iterations: of tuning in all, one view each.
        l1, ssim, perceptual, normal, distortion: weights of the losses; that of ssim counts
            1 - SSIM.
        perceptual_encoder: :func:`attnwarp.encoders.load_encoder`'s name of the perceptual loss.
        color_rate, geometry_rate: factors of the published learning rates, of the colours and of
            everything else.
        background: behind the splats while tuning.
        detail: where the editor works at a smaller size than the pictures', "change" adds the
            edit's change, enlarged, to the full picture; "none" tunes at the editor's size.

    Raises:
        ValueError: an unknown choice or a number out of range; the message names the field.

    Example:
        >>> from attnwarp.baselines import BaselineSettings
        >>> BaselineSettings().changed(noise="shared", steps=10).to_dict()["noise"]
        'shared'
    """

    seed: int = 0
    size: int | None = None
    steps: int = 20
    noise: Noise = "fresh"
    text_guidance: float | None = None
    image_guidance: float | None = None
    iterations: int = 1000
    l1: float = 1.0
    ssim: float = 0.2
    perceptual: float = 0.0
    normal: float = 0.0
    distortion: float = 0.0
    perceptual_encoder: str = "perceptual-small"
    color_rate: float = 1.0
    geometry_rate: float = 1.0
    background: Background = "black"
    detail: Detail = "change"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
            if field.name in _CHOICES:
                check.one_of(value, get_args(_CHOICES[field.name]), field.name)
            elif field.name in _NUMBERS:
                object.__setattr__(self, field.name, _checked_number(field.name, value))
            elif field.name in _TEXTS and not (value is None and field.name in _OPTIONAL):
                check.text(value, field.name)
            elif field.name in ("start", "starts"):
                steps = _checked_timesteps(field.name, getattr(self, field.name))
                object.__setattr__(self, field.name, steps)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values in the order of the fields."""
        values = asdict(self)
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    def changed(self: S, **changes: Any) -> S:
        """The same settings with some fields changed.

        Raises:
            ValueError: no such field, or a value out of range; the message names it.
        """
        for name in changes:
            check.one_of(name, [field.name for field in fields(self)], "setting")
        return replace(self, **changes)


@dataclass(frozen=True)
class ByViewSettings(BaselineSettings):
    """Settings of :func:`attnwarp.baselines.by_view`.

    The losses, rates and iterations are those of :class:`attnwarp.propagate.PropagateSettings`, so
    that the two differ in the edits alone.

    Args:
        start: (lowest, highest) timestep, of which each edit draws one to start from; None for pure
            noise.
        batch: views that go through the network together; 1 where ``start`` is given and the noise
            is fresh. Another batch gives other bits.

    Example:
        >>> from attnwarp.baselines import ByViewSettings
        >>> ByViewSettings(batch=0)
        Traceback (most recent call last):
        ValueError: batch: got 0, expected a whole number >= 1
    """

    iterations: int = 900
    ssim: float = 0.0
    perceptual: float = 1.0
    normal: float = 0.05
    distortion: float = 0.01
    color_rate: float = 4.0
    start: tuple[int, int] | None = None
    batch: int = 4


@dataclass(frozen=True)
class IGS2GSSettings(BaselineSettings):
    """Settings of :func:`attnwarp.baselines.igs2gs`.

    Args:
        every: iterations of tuning after which all views are edited again.
        start: (lowest, highest) timestep, of which each edit draws one to start from.

    Example:
        >>> from attnwarp.baselines import IGS2GSSettings
        >>> settings = IGS2GSSettings(iterations=3000)
        >>> settings.start, settings.iterations / settings.every  # a full round and a part
        ((700, 980), 1.2)
    """

    iterations: int = 7500
    every: int = 2500
    start: tuple[int, int] = (700, 980)


@dataclass(frozen=True)
class DGESettings(BaselineSettings):
    """Settings of :func:`attnwarp.baselines.dge`.

    Args:
        every: iterations of tuning after which other views are drawn and edited.
        views: that a round edits; all where there are fewer.
        batch: neighbouring views that share a key view.
        starts: timestep that a round starts from; the last also serves all further rounds.
        plain_below: timestep below which every view has its own attention.
        nearest: key views that a token is matched in; one for the first batch.
        epipolar: distance in px of the layer from the epipolar line beyond which matches are
            excluded; None excludes none.

    Example:
        >>> from attnwarp.baselines import DGESettings
        >>> DGESettings().starts  # nearly pure noise first, small changes after
        (998, 299)
    """

    iterations: int = 1500
    l1: float = 10.0
    ssim: float = 0.0
    perceptual: float = 10.0
    every: int = 500
    views: int = 20
    batch: int = 5
    starts: tuple[int, ...] = (998, 299)
    plain_below: int = 100
    nearest: int = 2
    epipolar: float | None = 1.0


@dataclass(frozen=True)
class GaussCtrlSettings(BaselineSettings):
    """Settings of :func:`attnwarp.baselines.gaussctrl`.

    Args:
        views: that are edited: an equal share of each contiguous part of the views, at random; all
            where there are fewer.
        references: parts of the views, and reference views, one a part.
        self_share: weight of a view's own keys in the UNet's self-attention; the rest is shared
            equally by the reference views.
        control_share: the same in the ControlNet; None leaves its attention alone.
        latents: what an edit starts from: the DDIM "inversion" of the render, or "random" ones.
        source_prompt: of the inversion; None for the instruction.
        suffix: of the instruction.
        negative_prompt: of the unconditional branch; None for the editor's own.
        batch: views that go through the network together, besides the reference views.

    Example:
        >>> from attnwarp.baselines import GaussCtrlSettings
        >>> GaussCtrlSettings().self_share
        0.6
    """

    views: int = 40
    references: int = 4
    self_share: float = 0.6
    control_share: float | None = None
    latents: Latents = "inversion"
    source_prompt: str | None = ""
    suffix: str = ""
    negative_prompt: str | None = None
    batch: int = 5


_CHOICES: dict[str, Any] = {
    "noise": Noise,
    "latents": Latents,
    "background": Background,
    "detail": Detail,
}

_NUMBERS: dict[str, tuple[type, float, float]] = {
    "seed": (int, 0, 2**62),
    "size": (int, 1, math.inf),
    "steps": (int, 1, 1000),
    "iterations": (int, 0, math.inf),
    "every": (int, 1, math.inf),
    "views": (int, 1, math.inf),
    "batch": (int, 1, math.inf),
    "nearest": (int, 1, 2),
    "references": (int, 1, math.inf),
    "plain_below": (int, 0, 1000),
    "epipolar": (float, 0, math.inf),
    "self_share": (float, 0, 1),
    "control_share": (float, 0, 1),
    **dict.fromkeys(
        (
            "text_guidance", "image_guidance", "l1", "ssim", "perceptual", "normal", "distortion",
            "color_rate", "geometry_rate",
        ),
        (float, 0, math.inf),
    ),
}  # fmt: skip

_TEXTS = {"perceptual_encoder", "source_prompt", "suffix", "negative_prompt"}

_OPTIONAL = {
    "size", "text_guidance", "image_guidance", "control_share", "epipolar", "source_prompt",
    "negative_prompt",
}  # fmt: skip


def _checked_number(name: str, value: Any) -> float | None:
    kind, low, high = _NUMBERS[name]
    if value is None and name in _OPTIONAL:
        return None
    return check.number(value, low, high, name, whole=kind is int)


def _checked_timesteps(name: str, value: Any) -> tuple[int, ...] | None:
    if value is None and name == "start":
        return None
    right = isinstance(value, tuple) and all(
        check.is_number(t, whole=True) and 0 <= t < PUBLISHED_STEPS for t in value
    )
    limits = f"of Stable Diffusion, in [0, {PUBLISHED_STEPS - 1}]"
    if name == "start":
        if not right or len(value) != 2 or value[0] > value[1]:
            raise ValueError(f"start: got {value!r}, expected (lowest, highest) timestep {limits}")
    elif not right or not value:
        raise ValueError(f"starts: got {value!r}, expected timesteps {limits}, at least one")
    return tuple(int(t) for t in value)


_STABLE_DIFFUSION: dict[str, Any] = {
    "suffix": ", best quality, extremely detailed",
    "negative_prompt": (
        "longbody, lowres, bad anatomy, bad hands, missing fingers, extra digit, fewer digits,"
        " cropped, worst quality, low quality"
    ),
    "text_guidance": 5.0,
}

_IGS2GS = IGS2GSSettings(text_guidance=12.5, image_guidance=1.5)

PRESETS: dict[str, dict[str, BaselineSettings]] = {
    "by_view": {"default": ByViewSettings()},
    "igs2gs": {
        "default": IGS2GSSettings(),
        "released": _IGS2GS,
        "improved": replace(_IGS2GS, iterations=3000),
    },
    "dge": {
        "default": DGESettings(),
        "released": DGESettings(text_guidance=7.5, image_guidance=1.5),
    },
    "gaussctrl": {
        "default": GaussCtrlSettings(),
        "paper": GaussCtrlSettings(**_STABLE_DIFFUSION),
        "released": GaussCtrlSettings(control_share=0.0, source_prompt=None, **_STABLE_DIFFUSION),
        "random": GaussCtrlSettings(latents="random", **_STABLE_DIFFUSION),
    },
}
"""Settings by the method's name and their own.

``default``: the method, with the guidance and prompts of the editor at hand. The others have the
guidance and prompts published for Stable Diffusion.

``improved`` of ``igs2gs``: 3000 iterations in place of 7500. ``released`` of ``gaussctrl``: the
authors' code, which also aligns the ControlNet's attention, without a share of the view's own, and
inverts with the instruction. ``random``: GaussCtrl without its inversion.
"""


def preset(method: str, name: str = "default", **changes: Any) -> BaselineSettings:
    """Settings of a method by name, with some fields changed.

    Args:
        method: a key of :data:`attnwarp.baselines.METHODS`.
        name: of a preset of that method: "default", or one of its published settings.
        changes: fields of the method's settings.

    Raises:
        ValueError: an unknown method, preset or field, or a value out of range; the message names
            it.

    Example:
        >>> from attnwarp.baselines import preset
        >>> preset("igs2gs", "improved", seed=3).iterations
        3000
        >>> preset("dge", epipolar=None).epipolar is None  # matches anywhere
        True
    """
    check.one_of(method, list(PRESETS), "method")
    check.one_of(name, list(PRESETS[method]), "preset")
    return PRESETS[method][name].changed(**changes)
