"""Base of the methods' settings, and presets: the published settings and the recommended ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from attnwarp import check
from attnwarp.editing.schedule import PUBLISHED_STEPS
from attnwarp.errors import Named
from attnwarp.settings import Count, Number, Range, Seed, Settings, Weight

Noise = Literal["fresh", "shared"]
Latents = Literal["inversion", "random"]
Background = Literal["black", "white", "random"]
Composite = Literal["none", "black", "original"]

Steps = Annotated[int, Range(1, 1000)]


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
            1 - SSIM, that of distortion :func:`attnwarp.losses.depth_distortion`.
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


def needs_start(start: tuple[int, int] | None) -> None:
    """Refuse a method without the timestep at which its views begin."""
    if start is None:
        raise ValueError("start: got None, but views begin at pictures; give [lowest, highest]")


STABLE_DIFFUSION: dict[str, Any] = {
    "suffix": ", best quality, extremely detailed",
    "negative_prompt": (
        "longbody, lowres, bad anatomy, bad hands, missing fingers, extra digit, fewer digits,"
        " cropped, worst quality, low quality"
    ),
    "text_guidance": 5.0,
}
"""Prompts and guidance published for Stable Diffusion."""

PRESETS: Named[Named[MethodSettings]] = Named()
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
source's features at a weight that depends on the kind of attention, tolerant masks, and attention
to the source's edit where no warp reaches the marked thing.

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
