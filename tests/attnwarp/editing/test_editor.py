"""Oracle: diffusers' own pipelines on the same small random models, latents and noise."""

import itertools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import (
    AutoencoderTiny,
    ControlNetModel,
    DDIMScheduler,
    EulerAncestralDiscreteScheduler,
    PNDMScheduler,
)
from tiny_editors import controlnet, nearest_steps, pix2pix, unet

from attnwarp.editing.editor import edit, shared_noise
from attnwarp.editing.editors.controlnet import DepthControlNet, control_image
from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from attnwarp.editing.folder import load_parts
from attnwarp.editing.layers import all_layers
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.editing.schedule import (
    DDIM,
    following,
    published_steps,
    stable_diffusion_alphas,
    steps_from,
)
from attnwarp.editing.small import WEIGHTS, bundled, guide_of, load_editor
from attnwarp.errors import InputError, InputWarning
from attnwarp.methods.algorithms.attention_warping import inject

H, W = 16, 24


def picture(seed=3):
    return np.random.default_rng(seed).uniform(size=(H, W, 3)).astype(np.float32)


def depth_map():
    return 1 + np.random.default_rng(4).uniform(size=(H, W))


def editor_of(pipe, **settings):
    parts = {k: getattr(pipe, k) for k in ("unet", "vae", "text_encoder", "tokenizer", "scheduler")}
    if hasattr(pipe, "controlnet"):
        return DepthControlNet(**parts, controlnet=pipe.controlnet, **settings)
    return InstructPix2Pix(**parts, **settings)


def tensor(image):
    return torch.from_numpy(image).permute(2, 0, 1)[None]


SCHEDULES = {
    "leading": {},
    "trailing, zero SNR, predicts the picture": {
        "timestep_spacing": "trailing", "rescale_betas_zero_snr": True, "prediction_type": "sample", "set_alpha_to_one": True,
    },
    "trailing, v": {"timestep_spacing": "trailing", "prediction_type": "v_prediction", "set_alpha_to_one": True},
}  # fmt: skip


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize(("text", "image"), [(7.5, 1.5), (1.5, 1.0)])
def test_the_loop_gives_what_diffusers_instruct_pix2pix_gives(schedule, text, image):
    # In double precision: guidance amplifies what vector units of processors round differently.
    pipe = pix2pix().to(torch.float64)
    pipe.scheduler = DDIMScheduler.from_config(pipe.scheduler.config, **SCHEDULES[schedule])
    noise = torch.randn(
        (1, 4, H // 2, W // 2), generator=torch.Generator().manual_seed(8), dtype=torch.float64
    )
    theirs = pipe(
        "a bear", image=tensor(picture()), num_inference_steps=5, guidance_scale=text, image_guidance_scale=image,
        latents=noise, output_type="np",
    ).images[0]  # fmt: skip
    ours = edit(
        editor_of(pipe, text_guidance=text, image_guidance=image),
        [picture()],
        "a bear",
        steps=5,
        noise=noise,
    )
    assert np.abs(ours.images[0] - theirs).max() < 1e-6
    assert theirs.std() > 0.01


@pytest.mark.parametrize(("guidance", "scale"), [(5.0, 1.0), (1.0, 0.7)])
def test_the_loop_gives_what_diffusers_controlnet_gives(guidance, scale):
    pipe = controlnet()
    noise = torch.randn((1, 4, H // 2, W // 2), generator=torch.Generator().manual_seed(8))
    theirs = pipe(
        "a bear", image=tensor(control_image(depth_map())), num_inference_steps=5, guidance_scale=guidance,
        controlnet_conditioning_scale=scale, negative_prompt="blurred", latents=noise, output_type="np", height=H, width=W,
    ).images[0]  # fmt: skip
    editor = editor_of(pipe, text_guidance=guidance, control_scale=scale, negative_prompt="blurred")
    ours = edit(editor, [depth_map()], "a bear", steps=5, noise=noise)
    assert np.abs(ours.images[0] - theirs).max() < 1e-5
    blind = edit(editor, [depth_map().T.reshape(H, W)], "a bear", steps=5, noise=noise)
    assert np.abs(blind.images[0] - theirs).max() > 1e-4  # the depth map counts


def test_views_edited_together_start_from_one_noise_and_come_out_as_each_alone():
    editor = editor_of(pix2pix())
    views = [picture(1), picture(2)]
    together = edit(editor, views, "a bear", steps=3, seed=5)
    noise = shared_noise((2, 4, H // 2, W // 2), 5)
    assert torch.equal(noise[0], noise[1])
    for view, image in zip(views, together.images, strict=True):
        alone = edit(editor, [view], "a bear", steps=3, seed=5).images[0]
        assert np.abs(alone - image).max() < 1e-5


def test_a_start_at_t_begins_at_the_views_noised_latents():
    editor = editor_of(pix2pix())
    seen = []
    result = edit(
        editor,
        [picture()],
        "a bear",
        steps=4,
        start=700,
        on_step=lambda step, steps, x: seen.append((step, steps)),
    )
    assert result.timesteps == [700, 525, 349, 174]
    assert seen == [(k, 4) for k in range(4)]
    # The first step by hand, in diffusers' own words.
    task = editor.task([picture()], "a bear")
    x0 = (
        editor.vae.encode(2 * tensor(picture()) - 1).latent_dist.mode()
        * editor.vae.config.scaling_factor
    )
    noise = shared_noise(task.shape, 0)
    scheduler = editor.scheduler
    x = scheduler.add_noise(x0, noise, torch.tensor([700]))
    for now, then in following(result.timesteps):
        a = scheduler.alphas_cumprod[now]
        after = scheduler.final_alpha_cumprod if then is None else scheduler.alphas_cumprod[then]
        e = task.predict(x, now)
        x = after.sqrt() * (x - (1 - a).sqrt() * e) / a.sqrt() + (1 - after).sqrt() * e
    assert torch.allclose(x, result.latents, rtol=0, atol=1e-5)


def test_steps_from_the_last_are_diffusers_trailing_ones():
    scheduler = DDIMScheduler(timestep_spacing="trailing")
    for steps in (1, 4, 7, 20, 50):
        scheduler.set_timesteps(steps)
        assert steps_from(999, steps) == scheduler.timesteps.tolist()
    with pytest.raises(ValueError, match="start, steps: got 3, 20"):
        steps_from(3, 20)


STABLE_DIFFUSION = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}


def test_published_steps_are_those_of_diffusers_stable_diffusion():
    schedule = DDIM.of(DDIMScheduler(**STABLE_DIFFUSION))
    for step in range(1000):
        assert schedule.published(step, 1) == [step]
    assert schedule.published(980, 20) == steps_from(980, 20)
    assert schedule.published(999, 1000) == list(range(999, -1, -1))
    for start in (-1, 1000):
        with pytest.raises(ValueError, match=rf"start: got {start}, expected a whole number in"):
            schedule.published(start, 1)


@pytest.mark.parametrize("start", [700, 853, 980])
def test_the_grid_of_a_scheduler_is_that_of_diffusers_with_so_many_training_steps(start):
    """IN2N, IGS2GS and others change the configuration before set_timesteps."""
    scheduler = DDIMScheduler(**STABLE_DIFFUSION, steps_offset=1)
    scheduler.register_to_config(num_train_timesteps=start)
    scheduler.set_timesteps(20)
    assert published_steps(start, 20, "scheduler") == scheduler.timesteps.tolist()
    schedule = DDIM.of(DDIMScheduler(**STABLE_DIFFUSION))
    assert schedule.published(start, 20, "scheduler") == scheduler.timesteps.tolist()
    with pytest.raises(ValueError, match="start, steps: got 19, 20"):
        published_steps(19, 20, "scheduler")


def test_noise_is_added_at_the_start_whatever_the_grid():
    editor = editor_of(pix2pix())
    seen = []
    handle = editor.unet.register_forward_pre_hook(
        lambda _, args: seen.append((int(args[1]), args[0][:1, :4].clone()))
    )
    try:
        for grid in ("even", "scheduler"):
            edit(editor, [picture()], "a bear", steps=1, start=700, grid=grid)
    finally:
        handle.remove()
    noise = shared_noise((1, 4, H // 2, W // 2), 0)
    expected = editor.schedule.add_noise(editor.encode([picture()]), noise, 700)
    assert [step for step, _ in seen] == [700, 1]
    for _, x in seen:
        assert torch.equal(x, expected)


def schedulers():
    """Those of the bundled editors, Stable Diffusion's without a rest of signal, and another."""
    yield from (DDIMScheduler.from_pretrained(WEIGHTS / name / "scheduler") for name in bundled())
    yield DDIMScheduler(**STABLE_DIFFUSION, rescale_betas_zero_snr=True)
    yield DDIMScheduler(num_train_timesteps=50, beta_schedule="squaredcos_cap_v2")


def test_a_published_step_is_the_one_that_leaves_as_much_of_the_picture():
    published = [0, 1, 20, 100, 299, 500, 700, 820, 980, 998, 999]
    for scheduler in schedulers():
        schedule = DDIM.of(scheduler)
        steps = [schedule.published(step, 1)[0] for step in published]
        assert steps == nearest_steps(schedule.alphas, published)
        # Stable Diffusion never hides a picture wholly, so no step becomes pure noise.
        assert schedule.alphas[steps[-1]] > 0
        # Those that methods take fall evenly on Stable Diffusion's clock.
        falling = [round(981 * k / 4) - 1 for k in (4, 3, 2, 1)]
        assert schedule.published(980, 4) == nearest_steps(schedule.alphas, falling)


def test_published_steps_with_one_nearest_step_fall_one_by_one():
    schedule = DDIM.of(DDIMScheduler(num_train_timesteps=50, beta_schedule="squaredcos_cap_v2"))
    steps = schedule.published(980, 40)
    assert len(steps) == 40
    assert all(after < before for before, after in itertools.pairwise(steps))
    with pytest.raises(ValueError, match=r"steps: got 60 from 980, which is step 47 .*at most 48"):
        schedule.published(980, 60)


@pytest.mark.parametrize("prediction", ["epsilon", "sample", "v_prediction"])
def test_a_step_is_diffusers_step(prediction):
    scheduler = DDIMScheduler(
        prediction_type=prediction, clip_sample=False, timestep_spacing="trailing"
    )
    scheduler.set_timesteps(10)
    schedule = DDIM.of(scheduler)
    generator = torch.Generator().manual_seed(0)
    x, output = (torch.randn((2, 4, 3, 3), generator=generator) for _ in range(2))
    for now, then in following(scheduler.timesteps.tolist()):
        theirs = scheduler.step(output, now, x).prev_sample
        assert torch.allclose(schedule.step(output, x, now, then), theirs, rtol=0, atol=1e-5)


HALF = pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])


@HALF
@pytest.mark.parametrize("prediction", ["epsilon", "sample", "v_prediction"])
def test_a_step_in_half_precision_is_the_formula_in_float64_rounded_once(prediction, dtype):
    alphas = stable_diffusion_alphas().float()
    schedule = DDIM(alphas, prediction, 1.0)
    generator = torch.Generator().manual_seed(0)
    x, output = (torch.randn((1, 4, 8, 8), generator=generator).to(dtype) for _ in range(2))
    wide, out = x.double(), output.double()

    def rounded_once(result, exact):
        assert result.dtype == dtype
        # Beside the rounding there is float32's error, over sqrt(1 - alpha-bar) >= 0.029.
        allowed = torch.finfo(dtype).eps / 2 * exact.abs() + 1e-5
        assert ((result.double() - exact).abs() <= allowed).all()

    for now, then in ((981, 961), (20, 1), (1, 0), (1, None), (0, None)):
        a, after = float(alphas[now]), 1.0 if then is None else float(alphas[then])
        root, rest = a**0.5, (1 - a) ** 0.5
        x0, noise = {
            "epsilon": ((wide - rest * out) / root, out),
            "sample": (out, (wide - root * out) / rest),
            "v_prediction": (root * wide - rest * out, root * out + rest * wide),
        }[prediction]
        expected = after**0.5 * x0 + (1 - after) ** 0.5 * noise
        rounded_once(schedule.step(output, x, now, then), expected)
        rounded_once(schedule.add_noise(x, output, now), root * wide + rest * out)


def test_latents_that_are_not_finite_are_refused_and_do_not_become_black():
    editor = editor_of(pix2pix())
    latents = torch.zeros(1, 4, 8, 12)
    latents[0, 1, 2, 3] = float("nan")
    with pytest.raises(ValueError, match=r"latents: 1 of 384 values are not finite; lower the"):
        editor.decode(latents)
    with pytest.raises(ValueError, match=r"decoded latents: \d+ of 1152 values are not finite"):
        editor.decode(torch.full((1, 4, 8, 12), 3e38))


@pytest.mark.door
def test_what_does_not_fit_is_refused_by_name():
    editor = editor_of(pix2pix())
    with pytest.raises(
        ValueError,
        match="guides: got 23 x 16 px, expected sides that are multiples of 2; resize or crop to 22 x 16",
    ):
        edit(editor, [picture()[:, :-1]], "a bear")
    with pytest.raises(ValueError, match="got 16 x 1 px, .*multiples of 2; resize to 16 x 2"):
        edit(editor, [picture()[:1, :16]], "a bear")
    with pytest.raises(ValueError, match="guides: got none"):
        edit(editor, [], "a bear")
    with pytest.raises(ValueError, match="guides: got values to 255"):
        edit(editor, [255 * np.ones((H, W, 3), np.float32)], "a bear")
    with pytest.raises(ValueError, match="expected one size"):
        edit(editor, [picture(), picture()[:8]], "a bear")
    with pytest.raises(
        ValueError, match=r"noise: got shape \(1, 4, 2, 2\), expected \(1, 4, 8, 12\)"
    ):
        edit(editor, [picture()], "a bear", noise=torch.zeros(1, 4, 2, 2))
    for steps in (0, 2.5, 1001):
        with pytest.raises(ValueError, match=f"steps: got {steps}, expected a whole number in"):
            edit(editor, [picture()], "a bear", steps=steps)
    # The scheduler's offset of 1 would move the first of 1000 steps beyond the last that it has.
    with pytest.raises(ValueError, match="steps: got 1000, .* timestep 1000 .* ends at 999"):
        edit(editor, [picture()], "a bear", steps=1000)
    assert max(editor.schedule.timesteps(999)) == 999
    latents = torch.zeros(1, 4, H // 2, W // 2)
    for name, value in (("start", 700), ("noise", latents)):
        with pytest.raises(ValueError, match=f"latents: got latents and {name}, expected one of"):
            edit(editor, [picture()], "a bear", latents=latents, **{name: value})
    with pytest.raises(ValueError, match="pictures: got pictures without start"):
        edit(editor, [picture()], "a bear", pictures=[picture()])
    with pytest.raises(ValueError, match="has .* tokens, the text encoder takes 24; shorten it"):
        edit(editor, [picture()], "a bear " * 30)
    with pytest.raises(ValueError, match="depth: got -1"):
        control_image(np.array([[1.0, -1.0]]))
    pipe = controlnet()
    with pytest.raises(ValueError, match="unet: takes 4 channels, expected 8: noisy latents and"):
        InstructPix2Pix(pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler)


def test_editors_are_read_from_folders_in_diffusers_format(tmp_path):
    for pipe, kind, guide in (
        (pix2pix(), InstructPix2Pix, picture()), (controlnet(), DepthControlNet, depth_map()),
    ):  # fmt: skip
        folder = tmp_path / kind.__name__
        pipe.save_pretrained(folder)
        loaded = edit(kind.from_folder(folder), [guide], "a bear", steps=2)
        assert np.array_equal(
            loaded.images[0], edit(editor_of(pipe), [guide], "a bear", steps=2).images[0]
        )


def test_a_base_and_a_controlnet_in_two_folders_are_one_editor(tmp_path):
    pipe = controlnet()
    pipe.save_pretrained(tmp_path / "base")
    (tmp_path / "base" / "controlnet").rename(tmp_path / "depth")
    both = f"{tmp_path / 'base'},{tmp_path / 'depth'}"
    assert guide_of(both) == "depth"
    ours = edit(load_editor(both, text_guidance=3.0), [depth_map()], "a bear", steps=2).images[0]
    expected = edit(editor_of(pipe, text_guidance=3.0), [depth_map()], "a bear", steps=2).images[0]
    assert np.array_equal(ours, expected)
    (tmp_path / "depth" / "config.json").unlink()
    with pytest.raises(InputError, match="lacks depth/config.json; fetch the ControlNet again"):
        load_editor(both)


@pytest.mark.door
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("{0},{0}/none", "CONTROLNET '{0}/none' is no folder"),
        ("{0}/none,{0}", "BASE '{0}/none' is no folder"),
        ("{0},", "expected two folders, BASE,CONTROLNET"),
        ("{0},{0},{0}", "expected two folders, BASE,CONTROLNET"),
    ],
)
def test_a_missing_one_of_two_folders_is_named(name, message, tmp_path):
    with pytest.raises(InputError, match=re.escape(message.format(tmp_path))):
        load_editor(name.format(tmp_path))


def test_a_folder_with_weights_of_half_precision_alone_is_read(tmp_path):
    """Oracle: diffusers' pipeline, which wrote the folder, cast to half and back."""
    pipe = controlnet().to(torch.float16)
    pipe.save_pretrained(tmp_path, variant="fp16")
    assert len(list(tmp_path.rglob("*.fp16.safetensors"))) == 4
    loaded = DepthControlNet.from_folder(str(tmp_path))
    assert loaded.unet.dtype == torch.float32
    for name in ("unet", "vae", "text_encoder", "controlnet"):
        weights = getattr(loaded, name).state_dict()
        for key, value in getattr(pipe, name).state_dict().items():
            assert torch.equal(weights[key], value.to(weights[key].dtype)), (name, key)


def test_a_view_that_sees_nothing_is_drawn_from_a_black_control_picture():
    """Oracle: diffusers' pipeline, given black."""
    pipe = controlnet()
    noise = torch.randn((1, 4, H // 2, W // 2), generator=torch.Generator().manual_seed(8))
    theirs = pipe(
        "a bear", image=torch.zeros(1, 3, H, W), num_inference_steps=2, guidance_scale=5.0, latents=noise,
        output_type="np", height=H, width=W,
    ).images[0]  # fmt: skip
    nothing = np.full((H, W), np.nan)
    ours = edit(editor_of(pipe), [nothing], "a bear", steps=2, noise=noise)
    assert np.abs(ours.images[0] - theirs).max() < 1e-5


@pytest.mark.door
@pytest.mark.parametrize(
    "lost",
    [
        "text_encoder/model.safetensors",
        "scheduler/scheduler_config.json",
        "controlnet/config.json",
        "tokenizer/tokenizer_config.json",
    ],
)
def test_a_missing_file_is_named(lost, tmp_path):
    controlnet().save_pretrained(tmp_path)
    (tmp_path / lost).unlink()
    with pytest.raises(InputError, match=f"lacks {lost}"):
        DepthControlNet.from_folder(tmp_path)


@pytest.mark.door
def test_networks_that_do_not_fit_each_other_are_refused_when_their_folder_is_read(tmp_path):
    pix2pix().save_pretrained(tmp_path / "instructions")
    controlnet().save_pretrained(tmp_path / "plain")
    xl = {
        "addition_embed_type": "text_time",
        "addition_time_embed_dim": 8,
        "projection_class_embeddings_input_dim": 80,
    }

    def other(name, network, base="plain"):
        """A copy of a folder of which one network is another."""
        shutil.copytree(tmp_path / base, tmp_path / name)
        network.save_pretrained(tmp_path / name / "unet")
        return str(tmp_path / name)

    control = f"{tmp_path / 'plain' / 'controlnet'}"
    for place, message in (
        (str(tmp_path / "plain"), "unet: takes 4 channels, expected 8: noisy"),
        (f"{tmp_path / 'instructions'},{control}", "unet: takes 8 channels, expected 4; a Contr"),
        (other("inpainting", unet(9)) + f",{control}", "unet: takes 9 channels, expected 4; a Con"),
        (other("unclip", unet(4, class_embed_type="timestep")) + f",{control}", "unet: takes a cl"),
        (other("wide", unet(8, cross_attention_dim=48), "instructions"),
         "unet: takes texts of 48 channels, and the text encoder gives 32; are both of one version"),
        (other("xl", unet(8, **xl), "instructions"), "unet: is of Stable Diffusion XL's kind"),
        (other("wide-base", unet(4, cross_attention_dim=48)) + f",{control}", "unet: takes texts"),
        (other("xl-base", unet(4, **xl)) + f",{control}", "unet: is of Stable Diffusion XL's kind"),
    ):  # fmt: skip
        # A folder with a controlnet beside the rest is no InstructPix2Pix: asked for by its class.
        load = load_editor if "," in place else InstructPix2Pix.from_folder
        with pytest.raises(InputError, match=message) as caught:
            load(place)
        assert place.partition(",")[0] in str(caught.value)
    wrong = ControlNetModel.from_unet(unet(4, cross_attention_dim=48))
    wrong.save_pretrained(tmp_path / "wrong")
    with pytest.raises(InputError, match="wrong: controlnet: takes texts of 48 channels"):
        load_editor(f"{tmp_path / 'plain'},{tmp_path / 'wrong'}")


@pytest.mark.door
@pytest.mark.parametrize("name", ["unet", "vae", "controlnet"])
def test_a_network_of_another_class_is_refused_by_its_name(name, tmp_path):
    controlnet().save_pretrained(tmp_path)
    path = tmp_path / name / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "_class_name": "Another"}))
    with pytest.raises(InputError, match=f"{name}: is of the class 'Another', expected"):
        load_editor(str(tmp_path))


def test_a_tiny_autoencoder_is_refused_by_pix2pix_and_taken_beside_a_controlnet(tmp_path):
    tiny = AutoencoderTiny(
        encoder_block_out_channels=(8, 8),
        decoder_block_out_channels=(8, 8),
        num_encoder_blocks=(1, 1),
        num_decoder_blocks=(1, 1),
    )
    for name, pipe in (("pix2pix", pix2pix()), ("plain", controlnet())):
        pipe.save_pretrained(tmp_path / name)
        shutil.rmtree(tmp_path / name / "vae")
        tiny.save_pretrained(tmp_path / name / "vae")
    with pytest.raises(InputError, match="pix2pix: vae: is an AutoencoderTiny"):
        load_editor(str(tmp_path / "pix2pix"))
    editor = load_editor(str(tmp_path / "plain"))
    latents = torch.randn(2, 4, 4, 4, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        expected = tiny.decode(latents).sample / 2 + 0.5
    assert torch.allclose(editor.pixels(latents), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("said", "size"), [(8, 16), ([6, 10], 20), (None, 128)])
def test_an_editors_own_size_is_that_of_its_longest_side(said, size):
    editor = editor_of(pix2pix())
    editor.unet.register_to_config(sample_size=said)
    assert editor.own_size == size  # its autoencoder halves once


def test_where_a_tokenizer_names_no_limit_the_text_encoders_is_one(tmp_path):
    pix2pix().save_pretrained(tmp_path)
    path = tmp_path / "tokenizer" / "tokenizer_config.json"
    config = json.loads(path.read_text())
    del config["model_max_length"]
    path.write_text(json.dumps(config))
    limitless = InstructPix2Pix.from_folder(tmp_path)
    assert limitless.tokenizer.model_max_length > 10**9
    with pytest.raises(ValueError, match="has .* tokens, the text encoder takes 24; shorten it"):
        limitless.check_text("a bear " * 30)
    # Padded to the limit, as diffusers pads.
    assert torch.equal(limitless.embed(["a bear"]), editor_of(pix2pix()).embed(["a bear"]))


def test_the_autoencoder_takes_one_picture_at_a_time_and_gives_what_a_batch_gives(monkeypatch):
    editor = editor_of(pix2pix())
    pixels = torch.rand(5, 3, H, W, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        coded = editor.vae.encode(2 * pixels - 1).latent_dist.mode()
        latents = coded * editor.vae.config.scaling_factor
        decoded = editor.vae.decode(coded).sample / 2 + 0.5
    taken = []
    for name in ("encode", "decode"):
        own = getattr(editor.vae, name)
        monkeypatch.setattr(
            editor.vae, name, lambda x, own=own, **more: taken.append(len(x)) or own(x, **more)
        )
    assert torch.allclose(editor.raw_latents(pixels), coded, rtol=0, atol=1e-5)
    assert torch.allclose(editor.pixels(latents), decoded, rtol=0, atol=1e-5)
    assert taken == [1] * 10


DEEP = {
    "block_out_channels": (16, 16, 16, 16),
    "down_block_types": ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
    "up_block_types": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
}  # as Stable Diffusion's


def test_sides_of_two_halvings_are_enough_for_stable_diffusions_three():
    """Oracle: diffusers' pipeline on latents of 12 x 20, whose last level is padded from 1.5 x 2.5
    to 2 x 3.
    """
    pipe = pix2pix()
    pipe.register_modules(unet=unet(8, **DEEP))
    editor = editor_of(pipe)
    assert editor.side_multiple == 2 * 4  # its autoencoder halves once
    assert editor_of(pix2pix()).side_multiple == 2 * 2
    guide = np.random.default_rng(3).uniform(size=(24, 40, 3)).astype(np.float32)
    noise = torch.randn((1, 4, 12, 20), generator=torch.Generator().manual_seed(8))
    theirs = pipe(
        "a bear", image=tensor(guide), num_inference_steps=3, guidance_scale=7.5, image_guidance_scale=1.5,
        latents=noise, output_type="np",
    ).images[0]  # fmt: skip
    settings = {"text_guidance": 7.5, "image_guidance": 1.5}
    plain = edit(editor_of(pipe, **settings), [guide], "a bear", steps=3, noise=noise)
    assert np.abs(plain.images[0] - theirs).max() < 1e-5
    # Features of every layer are recorded and injected at such a size, the odd ones among them.
    layers = all_layers(editor.unet)
    assert {layer.size((12, 20)) for layer in layers} == {(12, 20), (6, 10), (3, 5), (2, 3)}
    plan = RecordingPlan(layers, (12, 20), ("text", "image"), 3)
    with record(editor, plan) as recording:
        edit(editor, [guide], "a bear", steps=3, noise=noise)
    for layer in layers:
        features = recording.features(editor.schedule.timesteps(3)[0], layer, "text")
        assert features.shape == (1, np.prod(layer.size((12, 20))), 16)
    with inject(editor, recording, weight=lambda t, T: 1.0):
        again = edit(editor, [guide], "a bear", steps=3, noise=noise)
    plain = edit(editor, [guide], "a bear", steps=3, noise=noise)
    assert torch.equal(again.latents, plain.latents)
    with inject(editor, recording, weight=lambda t, T: 1.0):
        other = edit(editor, [1 - guide], "a bear", steps=3, noise=noise)
    alone = edit(editor, [1 - guide], "a bear", steps=3, noise=noise)
    assert (other.latents - alone.latents).abs().max() > 1e-3


@pytest.mark.door
def test_weights_that_lack_a_tensor_are_refused_and_not_filled_with_random_numbers(tmp_path):
    from safetensors.torch import load_file, save_file

    pix2pix().save_pretrained(tmp_path)
    path = tmp_path / "unet" / "diffusion_pytorch_model.safetensors"
    weights = load_file(path)
    del weights["conv_out.weight"]
    save_file(weights, path, metadata={"format": "pt"})
    with pytest.raises(InputError, match="its weights lack conv_out.weight"):
        load_parts(tmp_path, dtype=torch.float32)
    with pytest.raises(InputError, match="nowhere: no such folder"):
        load_parts(tmp_path / "nowhere", dtype=torch.float32)
    assert (
        json.loads((Path(tmp_path) / "model_index.json").read_text())["unet"][1]
        == "UNet2DConditionModel"
    )


@pytest.mark.door
def test_a_scheduler_without_ddim_steps_is_refused_with_the_remedy_which_works():
    pipe = pix2pix()
    parts = {name: getattr(pipe, name) for name in ("unet", "vae", "text_encoder", "tokenizer")}
    for kind in (EulerAncestralDiscreteScheduler, PNDMScheduler):
        other = kind.from_config(pipe.scheduler.config)
        with pytest.raises(
            ValueError, match=rf"got {kind.__name__}, expected a DDIMScheduler; .*\.config"
        ):
            InstructPix2Pix(**parts, scheduler=other)
        remedy = DDIMScheduler.from_config({**other.config, "clip_sample": False})
        assert InstructPix2Pix(**parts, scheduler=remedy).schedule.timesteps(3) == [667, 334, 1]
    clipping = DDIMScheduler.from_config({**pipe.scheduler.config, "clip_sample": True})
    with pytest.warns(InputWarning, match="clip_sample of its configuration is left out"):
        InstructPix2Pix(**parts, scheduler=clipping)


def test_a_folder_of_another_scheduler_that_says_nothing_of_clipping_clips_nothing(tmp_path):
    """Its own scheduler is the oracle, which cannot clip; a warning would fail this test."""
    pipe = pix2pix()
    pipe.scheduler = PNDMScheduler.from_config(pipe.scheduler.config)
    pipe.save_pretrained(tmp_path)
    file = tmp_path / "scheduler" / "scheduler_config.json"
    told = json.loads(file.read_text())
    assert told.pop("clip_sample", None) in (None, False)
    file.write_text(json.dumps(told))
    assert InstructPix2Pix.from_folder(tmp_path).scheduler.config.clip_sample is False


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused_by_name(value, tmp_path):
    pipe = pix2pix()
    pipe.unet.conv_in.weight.data[0, 0, 0, 0] = value
    pipe.save_pretrained(tmp_path)
    with pytest.raises(InputError, match=r"unet: its weights have NaN or inf.* in conv_in\.weight"):
        load_parts(tmp_path, dtype=torch.float32)


@pytest.mark.parametrize(
    "name", ["unet/diffusion_pytorch_model.safetensors", "tokenizer/tokenizer.json"]
)
def test_half_a_file_of_a_model_is_refused_in_one_line(name, tmp_path):
    pix2pix().save_pretrained(tmp_path)
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError) as refusal:
        load_parts(tmp_path, dtype=torch.float32)
    assert "\n" not in str(refusal.value)
