"""Editors with joint attention against diffusers' pipelines, closed forms, and planted mistakes."""

from dataclasses import replace

import numpy as np
import pytest
import tiny_joint as tiny
import torch
from PIL import Image

from attnwarp.editing.editor import drawn, edit
from attnwarp.editing.joint import pack
from attnwarp.editing.layers import choose_layers, hooked
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.editing.schedule import Flow
from attnwarp.methods.attention_warping import inject

STEPS = 3
GRID = {"klein": (32, 33), "kontext": (5, 8), "qwen": (3, 2), "qwen-plus": (3, 2), "sd3": (7, 6)}
"""Tokens of a picture: odd numbers where the pipeline takes them; klein's wants 64 px."""
GUIDED = {
    "klein": {"text_guidance": 2.5}, "kontext": {"true_guidance": 2.5}, "qwen": {"text_guidance": 2.5},
    "qwen-plus": {"text_guidance": 2.5}, "sd3": {"text_guidance": 2.5},
}  # fmt: skip
PLAIN = {name: {key: 1.0 for key in changes} for name, changes in GUIDED.items()}
FAST = ("kontext", "sd3", "klein")


def pipeline_edit(name, monkeypatch, editor, pictures, noise, dtype):
    """The (H, W, 3) picture of diffusers' own pipeline, and its last latents."""
    pipe = editor.pipe
    pipe.set_progress_bar_config(disable=True)
    h, w = pictures[0].shape[:2]
    levels = [np.rint(255 * one).astype(np.uint8) for one in pictures]
    images = [Image.fromarray(one) for one in levels]
    scale = editor.scale
    told = {k: v.to(dtype) for k, v in tiny.embedded(name, "red").items()}
    off = {k: v.to(dtype) for k, v in tiny.embedded(name, "", tiny.text_count(name, "")).items()}
    given = {"prompt_embeds": told["encoder_hidden_states"], "height": h, "width": w, "num_inference_steps": STEPS}
    if scale != 1:
        given["negative_prompt_embeds"] = off["encoder_hidden_states"]
    if "pooled_projections" in told:
        given["pooled_prompt_embeds"] = told["pooled_projections"]
        if scale != 1:
            given["negative_pooled_prompt_embeds"] = off["pooled_projections"]
    packed = noise if name == "sd3" else pack(noise)
    if name == "klein":
        h, w = noise.shape[2] // 2, noise.shape[3] // 2
        given |= {"latents": packed.transpose(1, 2).unflatten(2, (h, w)), "guidance_scale": scale, "image": images}
    elif name == "kontext":
        given |= {
            "latents": packed, "guidance_scale": editor.text_guidance, "true_cfg_scale": scale,
            "image": images[0], "max_area": h * w, "_auto_resize": False,
        }  # fmt: skip
    elif name == "sd3":
        first = editor.schedule.timesteps(STEPS, noise.shape[2:])[0]
        begun = editor.schedule.add_noise(editor.encode(pictures[:1]), noise, first)
        given |= {"latents": begun, "guidance_scale": scale, "strength": 0.6, "image": images[0]}
        given |= {"num_inference_steps": 5}  # of which a strength of 0.6 leaves 3
    else:
        import sys

        # The pipeline would edit at a million pixels, which takes minutes.
        size = (w, h, None) if name == "qwen" else (w, h)
        monkeypatch.setattr(sys.modules[type(pipe).__module__], "calculate_dimensions", lambda *_: size)
        given |= {"latents": packed, "true_cfg_scale": scale, "image": images if name == "qwen-plus" else images[0]}
    last = {}
    keep = {"callback_on_step_end": lambda *call: last.update(call[3]) or {}}
    image = pipe(**given, **keep, output_type="np").images[0]
    return image, last["latents"]


@pytest.mark.parametrize("guidance", [PLAIN, GUIDED], ids=["plain", "guided"])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in tiny.NAMES]
)
def test_the_loop_gives_what_diffusers_pipeline_gives(name, guidance, monkeypatch):
    editor = tiny.editor(name, **guidance[name])
    pictures = [tiny.picture(name, *GRID[name], seed=k) for k in range(1 + min(1, editor.references))]
    guide = pictures[0] if len(pictures) == 1 else np.stack(pictures)
    noise = drawn((1, *editor.noise_shape(pictures[0].shape[:2])), 3)
    more = {"pictures": None} if len(pictures) == 1 else {}
    ours = edit(editor, [guide], "red", steps=STEPS, noise=noise, **more).images[0]
    theirs, _ = pipeline_edit(name, monkeypatch, editor, pictures, noise, torch.float32)
    assert ours.std() > 0.02
    np.testing.assert_allclose(ours, theirs, atol=1e-5)  # sums in another order


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in tiny.NAMES]
)
def test_in_half_precision_the_loop_is_within_a_level_of_diffusers(name, monkeypatch):
    editor = tiny.editor(name, torch.bfloat16, **PLAIN[name])
    picture = tiny.picture(name, *GRID[name])
    noise = drawn((1, *editor.noise_shape(picture.shape[:2])), 3).bfloat16()


    def step(self, output, x, timestep, following, clean=None):
        """As diffusers rounds: the change too, before it is added."""
        change = torch.tensor(following or 0.0) - torch.tensor(timestep)
        return (x.float() + change * output).to(x.dtype)

    monkeypatch.setattr(Flow, "step", step)
    read = editor.pipe.image_processor.preprocess
    # A convolution rounds by the layout of its input.
    monkeypatch.setattr(editor.pipe.image_processor, "preprocess", lambda *a, **k: read(*a, **k).contiguous())
    ours = edit(editor, [picture], "red", steps=STEPS, noise=noise)
    theirs, last = pipeline_edit(name, monkeypatch, editor, [picture], noise, torch.bfloat16)
    assert torch.equal(editor.packed(ours.latents), last)
    # A level, and the half of one to which diffusers rounds its picture.
    assert np.abs(255 * ours.images[0] - 255 * theirs).max() <= 1.5
