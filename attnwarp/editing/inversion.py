"""Noise that reproduces a picture: DDIM inversion, and edit-friendly DDPM inversion.

Edit-friendly inversion lets a picture edited by hand be the source of an edit: its features are
recorded while its inverted noise is replayed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import check
from attnwarp.editing.editor import Editor, Image, Task, drawn, guided, shared_noise
from attnwarp.editing.schedule import Schedule, Time, following

Predict = Callable[[Tensor, Time], Tensor]
"""Function that returns a network's output for latents at a step, such as ``Task.predict``."""


def ddim_invert(
    schedule: Schedule,
    predict: Predict,
    latents: Tensor,
    timesteps: Sequence[Time],
    begin: Time | None = None,
) -> Tensor:
    """Invert a picture: find (B, C, h, w) latents at the first of ``timesteps`` from which the
    steps of a schedule reconstruct it.

    Each step uses the network's output at its starting latents (Song et al. 2021, section 4.3), so
    the reconstruction is exact for small steps only. Guidance above 1 increases the error, so
    invert with an unguided task.

    Args:
        schedule: schedule of the model; its network predicts noise or v. A network that predicts
            the picture gives no noise of a clean picture, and needs ``begin``.
        predict: function that returns the network's output.
        latents: (B, C, h, w) scaled latents of the picture.
        timesteps: timesteps of the edit, falling.
        begin: timestep of the noised ``latents``; ``timesteps`` are then all above it. None means
            clean latents.

    Raises:
        ValueError: the network predicts the picture and the latents are clean.

    Example:
        >>> from attnwarp.editing.schedule import DDIM
        >>> schedule = DDIM(torch.linspace(0.99, 0.01, 1000), "epsilon", 1.0)
        >>> steps = [900, 600, 300]
        >>> latents = torch.randn(1, 4, 2, 2, generator=torch.Generator().manual_seed(0))
        >>> predict = lambda x, timestep: torch.zeros_like(x)  # a network that sees no noise
        >>> x = ddim_invert(schedule, predict, latents, steps)
        >>> for now, then in following(steps):
        ...     x = schedule.step(predict(x, now), x, now, then)
        >>> bool((x - latents).abs().max() < 1e-5)
        True
    """
    if schedule.needs_noise and begin is None:
        raise ValueError(
            "schedule: this network predicts the picture, and an inversion needs its noise;"
            " use edit_friendly_invert, or begin at noised latents"
        )
    x, last = latents, begin
    with torch.no_grad():
        for timestep in reversed(timesteps):
            x = schedule.step(predict(x, timestep), x, last, timestep)
            last = timestep
    return x


def invert_view(
    editor: Editor,
    guide: npt.NDArray[Any],
    picture: Image,
    prompt: str,
    *,
    steps: int,
    seed: int = 0,
) -> Tensor:
    """Invert a view: (1, C, h, w) latents from which unguided DDIM with the prompt restores it.

    Args:
        editor: model that draws the full picture, such as a depth ControlNet.
        picture: (H, W, 3) picture of the view, in [0, 1].
        prompt: description of the picture; may be "".
        seed: seed of the noise added to the latents if the schedule needs some, the same for all
            views.

    Example:
        >>> import numpy as np
        >>> from attnwarp.editing.small import load_editor
        >>> depth, grey = np.ones((32, 32)), np.full((32, 32, 3), 0.5, np.float32)
        >>> invert_view(load_editor("small-depth"), depth, grey, "a bear", steps=2).shape
        torch.Size([1, 48, 8, 8])
    """
    latents = editor.encode([picture])
    timesteps = editor.schedule.timesteps(steps, (latents.shape[2], latents.shape[3]))
    begin = None
    if editor.schedule.needs_noise:
        *timesteps, begin = timesteps
        noise = shared_noise((1, *latents.shape[1:]), seed).to(latents)
        latents = editor.schedule.add_noise(latents, noise, begin)
    with guided(editor, text_guidance=1.0):
        task = editor.task([guide], prompt)
        return ddim_invert(editor.schedule, task.predict, latents, timesteps, begin)


def inversion_rows(editor: Editor, steps: int) -> int:
    """Count the rows through the network for the inversion of a view.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> inversion_rows(load_editor("small-depth"), 4)  # it begins at the lowest of four steps
        3
    """
    return steps - 1 if editor.schedule.needs_noise else steps


@dataclass(frozen=True, eq=False)
class NoiseMaps:
    """Initial latents and noise from which DDPM sampling reproduces a given picture.

    Attributes:
        timesteps: timesteps, falling.
        start: (B, C, h, w) latents at the first timestep.
        maps: (steps, B, C, h, w) noise of each step, in units of its standard deviation, or, if
            that is 0, the step's residual. Float32 for latents of half precision.
    """

    timesteps: Sequence[Time]
    start: Tensor
    maps: Tensor


def edit_friendly_invert(
    schedule: Schedule,
    predict: Predict,
    latents: Tensor,
    timesteps: Sequence[Time],
    *,
    noises: Tensor | None = None,
    seed: int = 0,
) -> NoiseMaps:
    """Invert by edit-friendly DDPM inversion (Huberman-Spiegelglas et al. 2024) with eta 1.

    Every x_t gets independent noise, so the noise maps are larger and carry the picture's layout.

    Args:
        schedule: schedule of the model, with any prediction type.
        latents: (B, C, h, w) scaled latents of the picture.
        timesteps: timesteps, falling; omit the noisiest to skip them. The paper takes
            ``schedule.timesteps(100)[36:]`` of Stable Diffusion, text guidance 3.5 with a prompt
            for the picture, and 15 in the replay with a prompt for its edit.
        noises: (steps, B, C, h, w) white noise of the steps, in the order of ``timesteps``; drawn
            from ``seed`` if omitted.

    Raises:
        ValueError: the noises have a different shape.

    Example:
        >>> from attnwarp.editing.schedule import DDIM
        >>> schedule = DDIM(torch.linspace(0.99, 0.01, 1000), "epsilon", 1.0)
        >>> latents = torch.randn(1, 4, 2, 2, generator=torch.Generator().manual_seed(0))
        >>> predict = lambda x, timestep: 0.1 * x  # any network
        >>> maps = edit_friendly_invert(schedule, predict, latents, [900, 600, 300])
        >>> bool((replay(schedule, predict, maps) - latents).abs().max() < 1e-5)
        True
    """
    shape = (len(timesteps), *latents.shape)
    if noises is None:
        noises = drawn(shape, seed)
    check.shape(noises, shape, "noises")
    noises = noises.to(latents)
    states = [
        schedule.add_noise(latents, noise, timestep)
        for noise, timestep in zip(noises, timesteps, strict=True)
    ] + [latents]
    start, maps = states[0], []
    x = start
    with torch.no_grad():
        for step, (now, then) in enumerate(following(timesteps)):
            mean, sigma = schedule.noisy_step(predict(x, now), x, now, then)
            scale = sigma if sigma > 0 else torch.ones_like(sigma)
            noise = (states[step + 1] - mean) / scale
            maps.append(noise)
            # Continue from the rounded map, so that rounding errors do not accumulate.
            x = (mean + scale * noise).to(x.dtype)
    return NoiseMaps(list(timesteps), start, torch.stack(maps))


def noise_maps(
    editor: Editor, task: Task, picture: Image, timesteps: Sequence[Time], seed: int
) -> NoiseMaps:
    """Compute noise maps of an external picture; its first state has the noise of all views."""
    latents = editor.encode([picture])
    noises = drawn((len(timesteps), *latents.shape), seed + 1)
    noises[0] = shared_noise((1, *latents.shape[1:]), seed)
    return edit_friendly_invert(editor.schedule, task.predict, latents, timesteps, noises=noises)


def replay(
    schedule: Schedule,
    predict: Predict,
    noise: NoiseMaps,
    *,
    on_step: Callable[[int, int, Tensor], None] | None = None,
) -> Tensor:
    """Sample (B, C, h, w) latents with given noise maps.

    The task of the inversion reproduces its picture; another prompt edits the picture.

    Args:
        noise: noise of :func:`edit_friendly_invert`.
        on_step: callback with the step, the number of steps and the latents, after each step.
    """
    x = noise.start
    with torch.no_grad():
        for step, (now, then) in enumerate(following(noise.timesteps)):
            mean, sigma = schedule.noisy_step(predict(x, now), x, now, then)
            scale = sigma if sigma > 0 else torch.ones_like(sigma)
            x = (mean + scale * noise.maps[step]).to(x.dtype)
            if on_step is not None:
                on_step(step, len(noise.timesteps), x)
    return x
