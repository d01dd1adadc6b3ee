"""Editors with joint attention against diffusers' pipelines, closed forms, and planted mistakes."""

import importlib.util
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import tiny_joint as tiny
import torch
import written_out_joint as written_out
from further import further
from PIL import Image

from attnwarp.editing.editor import drawn, edit
from attnwarp.editing.joint import pack
from attnwarp.editing.layers import choose_layers, hooked
from attnwarp.editing.memory import announced, folder_bytes, weight_bytes
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.editing.schedule import Flow
from attnwarp.editing.small import guide_of, load_editor, own_steps_of
from attnwarp.errors import InputError
from attnwarp.methods.algorithms.attention_warping import inject

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
    given = {
        "prompt_embeds": told["encoder_hidden_states"],
        "height": h,
        "width": w,
        "num_inference_steps": STEPS,
    }
    if scale != 1:
        given["negative_prompt_embeds"] = off["encoder_hidden_states"]
    if "pooled_projections" in told:
        given["pooled_prompt_embeds"] = told["pooled_projections"]
        if scale != 1:
            given["negative_pooled_prompt_embeds"] = off["pooled_projections"]
    packed = noise if name == "sd3" else pack(noise)
    if name == "klein":
        h, w = noise.shape[2] // 2, noise.shape[3] // 2
        given |= {
            "latents": packed.transpose(1, 2).unflatten(2, (h, w)),
            "guidance_scale": scale,
            "image": images,
        }
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
        monkeypatch.setattr(
            sys.modules[type(pipe).__module__], "calculate_dimensions", lambda *_: size
        )
        given |= {
            "latents": packed,
            "true_cfg_scale": scale,
            "image": images if name == "qwen-plus" else images[0],
        }
    last = {}
    keep = {"callback_on_step_end": lambda *call: last.update(call[3]) or {}}
    image = pipe(**given, **keep, output_type="np").images[0]
    return image, last["latents"]


@pytest.mark.parametrize("guidance", further(GUIDED, PLAIN), ids=["guided", "plain"])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in tiny.NAMES]
)
def test_the_loop_gives_what_diffusers_pipeline_gives(name, guidance, monkeypatch):
    editor = tiny.editor(name, **guidance[name])
    pictures = [
        tiny.picture(name, *GRID[name], seed=k) for k in range(1 + min(1, editor.references))
    ]
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
        """Round as diffusers does: the change too, before it is added."""
        change = torch.tensor(following or 0.0) - torch.tensor(timestep)
        return (x.float() + change * output).to(x.dtype)

    monkeypatch.setattr(Flow, "step", step)
    read = editor.pipe.image_processor.preprocess
    # A convolution rounds by the layout of its input.
    monkeypatch.setattr(
        editor.pipe.image_processor, "preprocess", lambda *a, **k: read(*a, **k).contiguous()
    )
    ours = edit(editor, [picture], "red", steps=STEPS, noise=noise)
    theirs, last = pipeline_edit(name, monkeypatch, editor, [picture], noise, torch.bfloat16)
    assert torch.equal(editor.packed(ours.latents), last)
    # A level, and the half of one to which diffusers rounds its picture.
    assert np.abs(255 * ours.images[0] - 255 * theirs).max() <= 1.5


def plan_of(editor, size, keep=None, steps=STEPS, views=1, kinds=None, blocks=None):
    layers = choose_layers(editor.layers(), kinds=kinds, blocks=blocks, sets=editor.block_sets)
    return RecordingPlan(layers, size, keep or editor.branches, steps, views=views)


@pytest.mark.parametrize("kinds", [None, ("key", "value")], ids=["outputs", "keys"])
@pytest.mark.parametrize("guidance", further(GUIDED, PLAIN), ids=["guided", "plain"])
@pytest.mark.parametrize("name", tiny.NAMES)
def test_recording_changes_no_bit_and_a_views_own_features_change_none(name, guidance, kinds):
    editor = tiny.editor(name, **guidance[name])
    views = [tiny.picture(name, 3, 2, seed=k) for k in range(2)]

    def edited(words):
        return edit(editor, views, words, steps=2).latents

    plain, other = edited("red"), edited("blue")
    plan = plan_of(editor, plain.shape[2:], steps=2, views=2, kinds=kinds)
    with record(editor, plan) as recording:
        assert torch.equal(edited("red"), plain)
    assert recording.bytes == plan.bytes
    with inject(editor, recording, weight=lambda t, T: 1.0, warps=(None, None)):
        assert torch.equal(edited("red"), plain)
        assert not torch.equal(edited("blue"), other)


def rows_seen(editor, hook, blocks=None):
    """All rows of each projection's input, and those of the text, in a step with ``hook``."""
    layers, seen, text = choose_layers(editor.layers(), blocks=blocks), {}, {}
    with hooked(editor, layers, hook):
        handles = []
        for layer in layers:
            module = editor.network.get_submodule(layer.name)
            handles.append(
                module.register_forward_hook(lambda m, a, o, n=layer.name: seen.update({n: a[0]}))
            )
            told = getattr(attention_of(editor, layer), "to_add_out", None)
            if layer.rows != "after text" and told is not None:
                keep = lambda m, a, o, n=layer.name: text.update({n: a[0]})  # noqa: E731
                handles.append(told.register_forward_hook(keep))
        edit(editor, [tiny.picture(editor_name(editor), 3, 2)], "red", steps=1)
        for handle in handles:
            handle.remove()
    return seen, text


def attention_of(editor, layer):
    return editor.network.get_submodule(".".join(layer.name.split(".")[:3]))


def editor_name(editor):
    return next(name for name, pipeline in tiny.PIPELINES.items() if pipeline == editor.pipeline)


@pytest.mark.parametrize("name", tiny.NAMES)
def test_rows_of_text_and_reference_keep_their_bits(name):
    editor, count = tiny.editor(name, **PLAIN[name]), 6
    for block in editor.block_sets["all"]:
        plain, words = rows_seen(editor, lambda *_: None, blocks=(block,))
        zeros, told = rows_seen(editor, lambda layer, tokens, call: 0 * tokens, blocks=(block,))
        for layer in choose_layers(editor.layers(), blocks=(block,)):
            ours, before = zeros[layer.name][0], plain[layer.name][0]
            first = tiny.TEXT if layer.rows == "after text" else 0
            image = torch.zeros(len(ours), dtype=torch.bool)
            image[first : first + count] = True
            assert (ours[image, : layer.channels] == 0).all()
            assert torch.equal(ours[~image], before[~image])
            assert torch.equal(ours[:, layer.channels :], before[:, layer.channels :])
            assert len(ours) == count if name == "sd3" else len(ours) >= 2 * count
            # The first layer of a block; a second one sees what the first has changed.
            if layer.name in words and "attn2" not in layer.name:
                assert torch.equal(words[layer.name], told[layer.name])


def wrong(editor, **changes):
    """The editor's first layer, read by another layout."""
    layer = choose_layers(editor.layers(), blocks=changes.pop("blocks", (0,)))[0]
    return replace(layer, **changes)


@pytest.mark.parametrize(
    ("name", "mistake"),
    [
        ("sd3", {"rows": "after text"}),  # the other networks' order
        ("kontext", {"rows": "image"}),  # rows of the reference taken too
        ("klein", {"rows": "image", "blocks": (3,)}),  # and those of the text
        ("qwen", {"level": 0}),  # a token per latent
    ],
)
def test_another_layout_is_refused_by_the_layers_name(name, mistake):
    editor = tiny.editor(name, **PLAIN[name])
    layer = wrong(editor, **mistake)
    plan = RecordingPlan(
        (layer,), editor.noise_shape((3 * tiny.SIDE[name], 2 * tiny.SIDE[name]))[1:], ("text",), 1
    )
    with pytest.raises(ValueError, match=layer.name), record(editor, plan):
        edit(editor, [tiny.picture(name, 3, 2)], "red", steps=1)


def test_text_read_as_image_is_seen_by_the_rows_that_change():
    editor = tiny.editor("kontext")
    layer = wrong(editor, rows="image first", blocks=(3,))
    seen = {}
    module = editor.network.get_submodule(layer.name)
    for name, hook in (
        ("plain", lambda *_: None),
        ("zeros", lambda layer, tokens, call: 0 * tokens),
    ):
        with hooked(editor, (layer,), hook):
            handle = module.register_forward_hook(lambda m, a, o, n=name: seen.update({n: a[0]}))
            edit(editor, [tiny.picture("kontext", 3, 2)], "red", steps=1)
            handle.remove()
    assert not torch.equal(seen["plain"][:, : tiny.TEXT], seen["zeros"][:, : tiny.TEXT])


@pytest.mark.parametrize("name", ["klein", "kontext", "qwen"])
def test_features_of_another_number_of_tokens_are_refused(name):
    editor = tiny.editor(name, **PLAIN[name])
    small, large = tiny.picture(name, 3, 2), tiny.picture(name, 3, 4)
    plan = plan_of(editor, editor.noise_shape(small.shape[:2])[1:])
    with record(editor, plan) as recording:
        edit(editor, [small], "red", steps=STEPS)
    # Shares of noise depend on the number of tokens; at the first, which is 1, sizes differ.
    with (
        pytest.raises(ValueError, match=r"size: .*give a warp|timestep: got"),
        inject(editor, recording, weight=lambda t, T: 1.0),
    ):
        edit(editor, [large], "red", steps=STEPS)


class Moved:
    """A picture moved by whole tokens, down and to the right; what comes in is not covered."""

    def __init__(self, size, down, right):
        self.size, self.by = size, (down, right)
        covered = torch.zeros(size)
        covered[down:, right:] = 1
        self.weight = covered.reshape(-1, 1)

    def at(self, size, *, source_size=None):
        assert size == self.size
        return self

    def warp_tokens(self, source):
        grid = source.unflatten(1, self.size)
        return grid.roll(self.by, dims=(1, 2)).flatten(1, 2)


def test_an_edit_with_injection_is_that_of_a_loop_written_out_in_float64():
    editor = tiny.editor("kontext", torch.float64, {"num_layers": 1, "num_single_layers": 1})
    source, target = tiny.picture("kontext", 4, 3, seed=1), tiny.picture("kontext", 4, 3, seed=2)
    warp, a, (h, w) = Moved((4, 3), 1, 1), 0.7, (4, 3)
    size = editor.noise_shape(source.shape[:2])[1:]
    noise = drawn((1, 1, *size), 5).double()
    with record(editor, replace(plan_of(editor, size, steps=1), dtype=torch.float64)) as recording:
        edit(editor, [source], "red", steps=1, noise=noise)
    with inject(editor, recording, weight=lambda t, T: a, warps=(warp,)):
        ours = edit(editor, [target], "red", steps=1, noise=noise).latents

    weights = {k: v.double() for k, v in editor.network.state_dict().items()}
    told = tiny.embedded("kontext", "red")
    y, x = np.divmod(np.arange(h * w), w)
    place = [torch.tensor(np.stack([np.full(h * w, t), y, x], 1)) for t in (0, 1)]
    ids = torch.cat([torch.zeros(tiny.TEXT, 3), *place]).double()
    tokens = pack(noise)[0]

    def one_step(picture, change):
        coded = editor.vae.encode(
            2 * torch.tensor(picture).double().permute(2, 0, 1)[None] - 1
        ).latent_dist.mode()
        reference = pack((coded - 0.0609) * 1.5035)[0]
        out = written_out.velocity(
            weights, editor.network.config, torch.cat([tokens, reference]), told["encoder_hidden_states"][0].double(),
            told["pooled_projections"].double(), ids, 1.0, editor.text_guidance, change,
        )  # fmt: skip
        return tokens - out[: h * w]  # the share falls from 1 to 0

    kept = {}

    def keep(name, rows):
        kept[name] = rows[: h * w].clone()
        return rows

    def blend(name, rows):
        rows, grid = rows.clone(), kept[name].reshape(h, w, -1)
        for i in range(1, h):
            for j in range(1, w):
                k = i * w + j
                rows[k] = a * grid[i - 1, j - 1] + (1 - a) * rows[k]
        return rows

    one_step(source, keep)
    expected, plain = one_step(target, blend), one_step(target, lambda name, rows: rows)
    assert (plain - expected).abs().max() > 0.01
    np.testing.assert_allclose(pack(ours)[0], expected, atol=2e-5)  # times and guidance are float32


def moved_positions(editor, down, right):
    """Move all pictures' positions by whole tokens, as a hook on the network's positions."""

    def qwen(module, args, output):
        first, *axes = (d // 2 for d in module.axes_dim)
        wave = module.pos_freqs  # a row for each position, the axes' waves side by side
        turn = torch.ones_like(wave[0])
        turn[first : first + axes[0]] = wave[down, first : first + axes[0]]
        turn[first + axes[0] :] = wave[right, first + axes[0] :]
        return output[0] * turn, output[
            1
        ] * turn  # its attention takes no empty text, which moves along

    def flux(module, args):
        ids = args[0].clone()
        ids[:, 1:3] += torch.tensor([float(down), float(right)])
        return (ids,)

    place = editor.network.pos_embed
    if "qwen" in editor_name(editor):
        return place.register_forward_hook(qwen)
    return place.register_forward_pre_hook(flux)


def features_of(editor, layers, picture):
    plan = RecordingPlan(layers, editor.noise_shape(picture.shape[:2])[1:], ("text",), 2)
    with record(editor, plan) as recording:
        edit(editor, [picture], "red", steps=2)
    return {
        layer.name: recording.features(recording.timesteps[-1], layer, "text") for layer in layers
    }


@pytest.mark.parametrize("name", ["klein", "kontext", "qwen"])
def test_features_moved_by_whole_tokens_are_those_computed_there(name, monkeypatch):
    if name != "qwen":
        monkeypatch.setattr(tiny, "text_count", lambda *_: 0)
    editor, picture = tiny.editor(name, **PLAIN[name]), tiny.picture(name, 5, 4)
    here = features_of(editor, editor.layers(), picture)
    handle = moved_positions(editor, 4, 3)
    there = features_of(editor, editor.layers(), picture)
    handle.remove()
    for layer in editor.layers():
        size = float(here[layer.name].abs().mean())
        assert (here[layer.name] - there[layer.name]).abs().max() < 1e-5 * max(1, 10 * size)


def test_keys_after_their_turning_are_not_those_of_the_moved_place():
    """The mistake: a turned key that is carried elsewhere keeps the angle of its old place."""
    editor = tiny.editor("kontext")
    layer = choose_layers(editor.layers(), kinds=("key",), blocks=(0,))[0]
    keys = features_of(editor, (layer,), tiny.picture("kontext", 5, 4))[layer.name]
    heads = keys[0].unflatten(1, (2, 16)).double()
    y, x = np.divmod(np.arange(20), 4)
    ids = torch.tensor(np.stack([0 * y, y, x], 1)).double()
    old, new = (
        written_out.turned(heads, place, [4, 4, 8])
        for place in (ids, ids + torch.tensor([0, 4, 3]))
    )
    apart = (old - new).norm() / new.norm()
    assert apart > 0.2


@pytest.mark.parametrize(("shift", "kept"), [(1, True), (0.5, False)])
def test_a_whole_token_of_a_packed_grid_moves_features_as_they_are(shift, kept):
    """A wall at depth 2, seen from a camera moved by a token or by half of one."""
    from attnwarp import Camera
    from attnwarp.warp import Surface, warp_surfaces

    editor = tiny.editor("qwen")
    layer, side = editor.layers()[0], editor.side_multiple
    h, w = 3 * side, 4 * side
    K = np.array([[float(w), 0, w / 2], [0, float(w), h / 2], [0, 0, 1]])
    away = np.eye(4)
    away[0, 3] = 2 * shift * side / w
    wall = Surface(np.full((h, w), 2.0), np.broadcast_to([0.0, 0, -1], (h, w, 3)))
    target, source = Camera(K, np.eye(4), w, h), Camera(K, away, w, h)
    grid = warp_surfaces(source, target, wall, wall).at(layer.size(editor.noise_shape((h, w))[1:]))
    tokens = torch.arange(12.0).reshape(1, 12, 1).square()
    found = grid.warp_tokens(tokens).reshape(3, 4)[:, :3]
    assert torch.allclose(found, tokens.reshape(3, 4)[:, 1:], atol=1e-4) == kept


@pytest.fixture(scope="module")
def klein(tmp_path_factory):
    folder = tmp_path_factory.mktemp("klein")
    return folder, tiny.klein_folder(folder)


def test_a_folder_is_read_by_its_index_and_edits_as_its_pipeline_does(klein):
    folder, pipe = klein
    assert guide_of(str(folder)) == "picture"
    assert own_steps_of(str(folder)) == 4
    editor = load_editor(str(folder))
    assert editor.branches == ("text",)  # distilled: no negative prompt
    picture = tiny.picture("klein", 32, 33)
    noise = drawn((1, *editor.noise_shape(picture.shape[:2])), 3)
    ours = edit(editor, [picture], "make it red", noise=noise)
    pipe.set_progress_bar_config(disable=True)
    theirs = pipe(
        image=[Image.fromarray(np.rint(255 * picture).astype(np.uint8))], prompt="make it red", num_inference_steps=4,
        latents=pack(noise).transpose(1, 2).unflatten(2, (32, 33)), output_type="np",
    ).images[0]  # fmt: skip
    np.testing.assert_allclose(ours.images[0], theirs, atol=1e-5)
    with pytest.raises(ValueError, match="480"):
        editor.check_text("red " * 200)


def test_what_a_folder_cannot_give_is_refused_by_name(klein, tmp_path):
    folder, _ = klein
    with pytest.raises(InputError, match="text_guidance: this model is distilled"):
        load_editor(str(folder), text_guidance=3.0)
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    index = json.loads((other / "model_index.json").read_text())
    (other / "model_index.json").write_text(json.dumps({**index, "_class_name": "FluxPipeline"}))
    with pytest.raises(InputError, match=r"'FluxPipeline'.*no editor reads.*Flux2KleinPipeline"):
        load_editor(str(other))
    (other / "model_index.json").write_text(json.dumps(index))
    if importlib.util.find_spec("torchvision") is None:
        (other / "processor").mkdir()
        with pytest.raises(InputError, match=r"processor: needs torchvision, which is not"):
            load_editor(str(other))
        (other / "processor").rmdir()
    (other / "text_encoder" / "model.safetensors").unlink()
    shutil.rmtree(other / "tokenizer")
    with pytest.raises(InputError, match=r"lacks text_encoder/model.safetensors, tokenizer/vocab"):
        load_editor(str(other))


def test_the_memory_of_weights_is_announced_before_anything_is_loaded(klein):
    """Oracle: the loaded weights."""
    folder, _ = klein
    weights = folder_bytes(folder, torch.float32)
    # A tied tensor is stored once, and a counter of the norm is no weight.
    assert weights == pytest.approx(weight_bytes(load_editor(str(folder))), rel=0.1)
    line = announced(str(folder), torch.bfloat16, "cpu")
    assert line == "weights of the editor in bfloat16: 0.00 GiB"
