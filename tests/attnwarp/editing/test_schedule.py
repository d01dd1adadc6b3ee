"""The flow's steps against diffusers' own scheduler, and against straight lines in float64."""

import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler

from attnwarp.editing.inversion import ddim_invert, edit_friendly_invert, replay
from attnwarp.editing.schedule import DDIM, Flow, following, stable_diffusion_alphas

SIZE = (6, 8)


def latents(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn((2, 4, *SIZE), generator=generator)


@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_a_step_of_a_flow_is_that_of_diffusers(shift):
    scheduler = FlowMatchEulerDiscreteScheduler(shift=shift)
    scheduler.set_timesteps(sigmas=[1.0, 0.75, 0.5, 0.25])

    def spacing(steps, size):
        even = [1 - k / steps for k in range(steps)]
        return [shift * s / (1 + (shift - 1) * s) for s in even]

    schedule = Flow(spacing)
    times = schedule.timesteps(4, SIZE)
    assert times == pytest.approx(scheduler.sigmas[:-1].tolist())
    x = theirs = latents()
    for (now, then), timestep in zip(following(times), scheduler.timesteps, strict=True):
        velocity = torch.sin(x)
        x = schedule.step(velocity, x, now, then)
        theirs = scheduler.step(torch.sin(theirs), timestep, theirs).prev_sample
    assert torch.allclose(x, theirs, rtol=0, atol=1e-5)
    noised = scheduler.scale_noise(latents(), scheduler.timesteps[1:2], latents(1))
    ours = schedule.add_noise(latents(), latents(1), times[1])
    assert torch.allclose(noised, ours, rtol=0, atol=1e-6)


@pytest.mark.parametrize("schedule", [Flow(), DDIM(stable_diffusion_alphas(), "epsilon", 1.0)])
def test_a_picture_and_its_noise_are_found_again_from_what_lies_between(schedule):
    """A network that knows both gives the velocity, or the noise."""
    clean, noise = latents().double(), latents(1).double()
    output = noise - clean if isinstance(schedule, Flow) else noise
    times = schedule.published(900, 5)
    assert list(times) == sorted(times, reverse=True)
    x = schedule.add_noise(clean, noise, times[0])
    for now, then in following(times):
        estimate = schedule.estimate(output, x, now)
        assert torch.allclose(estimate, clean, rtol=0, atol=1e-6)
        # What stands in place of the estimate ends as the picture, under the same noise.
        other = schedule.step(output, x, now, None, clean=clean + 1)
        assert torch.allclose(other, clean + 1, rtol=0, atol=1e-6)
        x = schedule.step(output, x, now, then)
    assert torch.allclose(x, clean, rtol=0, atol=1e-6)


def test_a_published_step_becomes_the_share_with_as_much_of_the_picture_for_the_same_noise():
    alphas = stable_diffusion_alphas()
    (share,) = Flow().published(700, 1)
    signal, noise = alphas[700].sqrt(), (1 - alphas[700]).sqrt()
    assert (1 - share) / share == pytest.approx(float(signal / noise))


def test_a_flow_is_inverted_and_replayed_to_its_picture():
    schedule, picture = Flow(), latents().double()

    def predict(x, timestep):
        return 0.3 * x + timestep

    times = schedule.timesteps(400, SIZE)
    x = ddim_invert(schedule, predict, picture, times)
    for now, then in following(times):
        x = schedule.step(predict(x, now), x, now, then)
    # Each of 400 steps asks the network a step away: 0.3 of what x moves in a step, at most 2 / 400.
    assert (x - picture).abs().max() < 0.3 * 2 / 400
    maps = edit_friendly_invert(schedule, predict, picture, times[::100])
    assert torch.allclose(replay(schedule, predict, maps), picture, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_step_of_a_flow_in_half_precision_is_rounded_once(dtype):
    x, output = latents().to(dtype), latents(1).to(dtype)
    result = Flow().step(output, x, 0.75, 0.5)
    exact = x.double() - 0.25 * output.double()
    assert result.dtype == dtype
    assert (
        (result.double() - exact).abs() <= torch.finfo(dtype).eps / 2 * exact.abs() + 1e-6
    ).all()
