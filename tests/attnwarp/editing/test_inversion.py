"""Oracles: diffusers' inverse scheduler and its LEDITS++ pipeline, and the pictures that were inverted."""

import numpy as np
import pytest
import torch
from diffusers import DDIMInverseScheduler, DDIMScheduler, LEditsPPPipelineStableDiffusion
from further import further
from PIL import Image
from tiny_editors import parts, unet

from attnwarp.editing.inversion import ddim_invert, edit_friendly_invert, replay
from attnwarp.editing.schedule import DDIM, following, stable_diffusion_alphas


def network(net, seed=2, *, strength=1.0):
    text = torch.randn((1, 5, 32), generator=torch.Generator().manual_seed(seed))

    def predict(x, timestep):
        with torch.no_grad():
            return strength * net(x, torch.tensor(timestep), text.expand(len(x), -1, -1)).sample

    return predict


def latents(seed=3):
    return torch.randn((1, 4, 8, 12), generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
def test_ddim_inversion_is_diffusers_inverse_scheduler(prediction):
    scheduler = DDIMScheduler.from_config(parts()["scheduler"].config, prediction_type=prediction)
    inverse = DDIMInverseScheduler.from_config(scheduler.config)
    predict = network(unet())
    scheduler.set_timesteps(10)
    inverse.set_timesteps(10)
    x = latents()
    for timestep in inverse.timesteps:
        x = inverse.step(predict(x, int(timestep)), int(timestep), x).prev_sample
    ours = ddim_invert(DDIM.of(scheduler), predict, latents(), scheduler.timesteps.tolist())
    assert torch.allclose(ours, x, rtol=0, atol=1e-5)


def test_ddim_inversion_of_gaussian_data_is_its_closed_form_and_leads_back():
    """For data of variance s^2 the best network is known, and the flow only scales: x_t / x_0 is the ratio of the
    standard deviations, sqrt(alpha-bar s^2 + 1 - alpha-bar) / s."""
    scheduler = DDIMScheduler.from_config(parts()["scheduler"].config, set_alpha_to_one=True)
    scheduler.set_timesteps(100)
    schedule, timesteps = DDIM.of(scheduler), scheduler.timesteps.tolist()
    spread = 0.8

    def predict(x, timestep):
        a = scheduler.alphas_cumprod[timestep]
        return (1 - a).sqrt() / (a * spread**2 + 1 - a) * x

    x = ddim_invert(schedule, predict, spread * latents(), timesteps)
    a = scheduler.alphas_cumprod[timesteps[0]]
    expected = (a * spread**2 + 1 - a).sqrt() * latents()
    assert float((x - expected).abs().max() / expected.abs().max()) < 0.02  # steps are finite
    for now, then in following(timesteps):
        x = schedule.step(predict(x, now), x, now, then)
    assert psnr(x, spread * latents()) > 30


def psnr(x, truth):
    span = float(truth.max() - truth.min())
    return 10 * np.log10(span**2 / float((x - truth).square().mean()))


def test_a_picture_that_a_network_drew_is_inverted_and_rebuilt(monkeypatch):
    """The start of GaussCtrl and attention warping. Oracle: the latents that were drawn, from other
    noise and in other steps. A network of random weights takes no noise away, so its flow is
    followed where the signal prevails.
    """
    from tiny_editors import controlnet

    from attnwarp.editing.editor import edit
    from attnwarp.editing.editors.controlnet import DepthControlNet
    from attnwarp.editing.inversion import invert_view

    pipe = controlnet()
    names = ("unet", "vae", "text_encoder", "tokenizer", "scheduler", "controlnet")
    editor = DepthControlNet(*(getattr(pipe, name) for name in names), text_guidance=1.0)
    editor.schedule = DDIM(torch.linspace(0.9999, 0.6, 1000), "epsilon", 1.0)
    depth = np.random.default_rng(0).uniform(1, 3, (16, 16))
    drawn = edit(editor, [depth], "a bear", steps=10, seed=5)
    # An autoencoder of random weights would not give the picture back.
    monkeypatch.setattr(editor, "encode", lambda pictures: drawn.latents)
    latents = invert_view(editor, depth, drawn.images[0], "a bear", steps=20)
    rebuilt, missed = (
        edit(editor, [depth], "a bear", steps=20, latents=x).latents
        for x in (latents, drawn.latents)
    )
    assert psnr(missed, drawn.latents) < 27  # not inverted
    assert psnr(rebuilt, drawn.latents) > 30


def test_ddim_inversion_needs_a_network_that_predicts_noise():
    schedule = DDIM(parts()["scheduler"].alphas_cumprod, "sample", 1.0)
    with pytest.raises(ValueError, match="an inversion needs its noise"):
        ddim_invert(schedule, network(unet()), latents(), [500, 0])


class WholeSteps(DDIMScheduler):
    """diffusers' LEDITS++ asks for noise at steps that are floats, which its own DDIM scheduler refuses."""

    def add_noise(self, original_samples, noise, timesteps):
        return super().add_noise(original_samples, noise, timesteps.long())


@pytest.mark.parametrize("skip", [0.0, 0.25])
def test_edit_friendly_inversion_is_that_of_diffusers(skip):
    made = parts()
    made["scheduler"] = WholeSteps.from_config(made["scheduler"].config)
    pipe = LEditsPPPipelineStableDiffusion(
        unet=unet(),
        **made,
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipe.set_progress_bar_config(disable=True)
    pixels = np.random.default_rng(0).integers(0, 256, (32, 64, 3), dtype=np.uint8)
    pipe.invert(
        Image.fromarray(pixels), source_prompt="", num_inversion_steps=8, skip=skip,
        generator=torch.Generator().manual_seed(6),
    )  # fmt: skip
    x0, _ = pipe.encode_image(Image.fromarray(pixels), dtype=torch.float32)
    timesteps = [int(t) for t in pipe.inversion_steps]
    generator = torch.Generator().manual_seed(6)
    # They draw from the last step to the first.
    noises = torch.stack([torch.randn(x0.shape, generator=generator) for _ in timesteps]).flip(0)
    words = pipe.tokenizer("", padding="max_length", max_length=24, return_tensors="pt").input_ids
    with torch.no_grad():
        text = made["text_encoder"](words)[0]

        def predict(x, timestep):
            return pipe.unet(x, torch.tensor(timestep), text).sample

        ours = edit_friendly_invert(DDIM.of(pipe.scheduler), predict, x0, timesteps, noises=noises)
    assert torch.allclose(ours.start, pipe.init_latents, rtol=0, atol=1e-5)
    # A map is a difference over sigma, which is as small as 0.04 at the last steps.
    assert torch.allclose(ours.maps, pipe.zs, rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    "changes",
    further(
        {"prediction_type": "sample", "rescale_betas_zero_snr": True, "timestep_spacing": "trailing", "set_alpha_to_one": True},
        {"set_alpha_to_one": True},
        {},
    ),
    ids=["zero SNR, predicts the picture", "a last step without noise", "epsilon"],
)  # fmt: skip
def test_replaying_the_maps_gives_the_picture_back_to_float_error(changes):
    scheduler = DDIMScheduler.from_config(parts()["scheduler"].config, **changes)
    scheduler.set_timesteps(20)
    schedule, predict = DDIM.of(scheduler), network(unet())
    noise = edit_friendly_invert(schedule, predict, latents(), scheduler.timesteps.tolist(), seed=1)
    assert torch.allclose(replay(schedule, predict, noise), latents(), rtol=0, atol=1e-5)
    other = replay(schedule, network(unet(), seed=9), noise)
    assert float((other - latents()).abs().max()) > 1e-3  # another prompt makes another picture
    again = edit_friendly_invert(schedule, predict, latents(), scheduler.timesteps.tolist(), seed=1)
    assert torch.equal(again.maps, noise.maps)


def test_inversions_in_half_precision_keep_their_coefficients():
    """bfloat16 rounds the last steps' alpha-bar to 1. Oracle: with a network that predicts noise 1
    everywhere, one step of inversion adds exactly that; and the picture is led back to."""
    alphas = stable_diffusion_alphas().float()
    x = latents().bfloat16()
    inverted = ddim_invert(
        DDIM(alphas, "epsilon", 1.0), lambda x, timestep: torch.ones_like(x), x, [1]
    )
    a = float(alphas[1])
    exact = a**0.5 * x.double() + (1 - a) ** 0.5
    assert inverted.dtype == torch.bfloat16
    assert ((inverted.double() - exact).abs() <= 2**-8 * exact.abs() + 1e-6).all()

    def predict(x, timestep):
        return 0.3 * x

    picture = DDIM(alphas, "sample", 1.0)
    maps = edit_friendly_invert(picture, predict, x, [900, 500, 100, 1])
    assert torch.equal(replay(picture, predict, maps), x)


def test_a_picture_edited_by_hand_can_be_the_source():
    """Its own noise is replayed while features are recorded; they then go into another view's edit."""
    from tiny_editors import pix2pix

    from attnwarp.editing.editor import edit
    from attnwarp.editing.editors.pix2pix import InstructPix2Pix
    from attnwarp.editing.recording import RecordingPlan, record
    from attnwarp.methods.algorithms.attention_warping import inject

    pipe = pix2pix()
    editor = InstructPix2Pix(pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler)
    rng = np.random.default_rng(0)
    before, by_hand, other = (rng.uniform(size=(16, 24, 3)).astype(np.float32) for _ in range(3))
    task, timesteps = editor.task([before], "a bear"), editor.schedule.timesteps(4)
    wanted = editor.encode([by_hand])
    noise = edit_friendly_invert(editor.schedule, task.predict, wanted, timesteps)
    plan = RecordingPlan(editor.layers(), (8, 12), ("text", "image"), 4)
    with record(editor, plan) as recording:
        source = replay(editor.schedule, task.predict, noise)
    assert torch.allclose(source, wanted, rtol=0, atol=1e-5)
    alone = edit(editor, [other], "a bear", steps=4).latents
    with inject(editor, recording, weight=lambda t, T: 0.9):
        assert not torch.allclose(
            edit(editor, [other], "a bear", steps=4).latents, alone, atol=1e-3
        )
