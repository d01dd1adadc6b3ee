"""The bundled editors as they ship: sizes, cards, and diffusers' own pipeline on the same folder."""

import copy
import json
import re
import shutil
import unicodedata
import warnings

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionControlNetPipeline, StableDiffusionInstructPix2PixPipeline

import attnwarp.editing.small_unet  # noqa: F401  diffusers imports no module that a folder names
from attnwarp.editing.editor import edit
from attnwarp.editing.editors.controlnet import control_image
from attnwarp.editing.latents import HaarLatents, haar_basis
from attnwarp.editing.small import (
    DEPTH_GUIDANCE,
    IMAGE_GUIDANCE,
    LOOKS,
    TEXT_GUIDANCE,
    WEIGHTS,
    bundled,
    check_sums,
    check_words,
    guide_of,
    load_editor,
    unknown_words,
)
from attnwarp.errors import InputError, InputWarning
from attnwarp_eval.drawn.worlds import OBJECTS
from training.worlds.editing_pairs import ambiguous_instruction, instruction

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")


@pytest.mark.parametrize("name", bundled())
def test_a_bundled_editor_is_small_has_a_card_and_edits_as_diffusers_pipeline_does(name):
    files = [p for p in (WEIGHTS / name).rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in files) < 20e6
    assert (WEIGHTS / name / "card.md").read_text().startswith(f"# {name}\n")
    guide = np.random.default_rng(0).uniform(0.2, 0.8, (48, 64, 3)).astype(np.float32)
    if guide_of(name) == "depth":
        guide = guide[..., 0] + 1
    noise = torch.randn((1, 48, 12, 16), generator=torch.Generator().manual_seed(1))
    theirs = drawn_by_diffusers(name, guide, "make it red", noise)
    ours = edit(load_editor(name), [guide], "make it red", steps=5, noise=noise).images[0]
    assert np.abs(ours - theirs).max() < 1e-5
    other = edit(load_editor(name), [guide], "make it night", steps=5, noise=noise).images[0]
    assert np.abs(ours - other).mean() > 1e-3  # the words count


def drawn_by_diffusers(name, guide, words, noise):
    """The picture of the pipeline that an editor's folder is written for."""
    depth = guide_of(name) == "depth"
    kind = StableDiffusionControlNetPipeline if depth else StableDiffusionInstructPix2PixPipeline
    pipe = kind.from_pretrained(WEIGHTS / name, torch_dtype=torch.float32)
    pipe.set_progress_bar_config(disable=True)
    image = torch.from_numpy(control_image(guide) if depth else guide).permute(2, 0, 1)[None]
    own = (
        {"guidance_scale": DEPTH_GUIDANCE, "height": 48, "width": 64}
        if depth
        else {"guidance_scale": TEXT_GUIDANCE, "image_guidance_scale": IMAGE_GUIDANCE}
    )
    shared = {"num_inference_steps": 5, "latents": noise, "output_type": "np"}
    return pipe(words, image=image, **own, **shared).images[0]


def test_small_plain_is_bundled_and_an_unknown_name_is_refused():
    assert "small-plain" in bundled()
    with pytest.raises(
        InputError, match="editor 'small-plan': neither bundled.*did you mean 'small-plain'"
    ):
        load_editor("small-plan")


@pytest.mark.parametrize("name", bundled())
def test_a_bundled_editor_with_a_flipped_bit_is_refused_by_the_files_name(name, tmp_path):
    folder = shutil.copytree(WEIGHTS / name, tmp_path / name)
    check_sums(folder)
    path = folder / "unet" / "diffusion_pytorch_model.safetensors"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    with pytest.raises(
        InputError, match="diffusion_pytorch_model.safetensors: is missing or damaged"
    ):
        check_sums(folder)


def test_words_that_no_training_text_has_are_named_and_no_others():
    """Oracle: the words that the card and the shipped scenes' edits use, and invented ones."""
    with pytest.warns(InputWarning, match="not trained on 'zorgoblatt', 'Sphinx', so"):
        check_words("small-plain", "make the red bear zorgoblatt and turn it into the Sphinx")
    with pytest.warns(InputWarning, match=r"trained on 'stripes' \(it knows striped\), so"):
        check_words("small-plain", "make all of it red with stripes, please")
    with pytest.raises(InputError, match="it knows striped for 'Stripes'; "):
        check_words("small-plain", "Stripes")
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        for text in ("Make the ground snow!", "turn the man into bronze, at night", "striped"):
            check_words("small-plain", text)
        check_words("a/folder", "zorgoblatt")


@pytest.mark.parametrize("name", ["small-plain", "small-depth"])
def test_the_card_lists_the_words_for_a_look_exactly(name):
    """Oracle: the tokenizer's file, whose tokens hold each training word whole."""
    card = (WEIGHTS / name / "card.md").read_text()
    tokens = json.loads((WEIGHTS / name / "tokenizer/tokenizer.json").read_text())["model"]["vocab"]
    looks, things = (
        re.search(rf"\*\*Words for {what}\*\*: (.*)\.\n", card)[1].split(", ")
        for what in ("a look", "things")
    )
    assert set(looks) == {word for word in LOOKS if f"Ġ{word}" in tokens}
    assert len(things) > 50 and not set(looks) & set(things)
    assert all(f"Ġ{word}" in tokens for word in things)


def test_words_are_unknown_where_the_tokenizer_takes_them_apart():
    """Oracle: transformers' tokenizer."""
    tokenizer = load_editor("small-plain").tokenizer
    known = [
        token[1:] for token in tokenizer.get_vocab() if token[0] == "Ġ" and token[1:].isalpha()
    ]
    words = [*known, *["furious", "Snowman", "XYLOPHONE", "hüte", "the", "ﬁre"]]
    apart = [word for word in words if len(tokenizer.tokenize(word)) > 1]
    assert unknown_words("small-plain", " ".join(words)) == [
        unicodedata.normalize("NFKC", word) for word in apart
    ]
    assert len(apart) < len(words) / 2


def test_an_instruction_that_names_no_look_is_refused_and_none_of_the_training_is():
    """Oracle: the sentences that the editor was trained on."""
    random = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        for kind, finishes in (
            ("color", (0, 1)), ("material", range(2, 8)), ("pattern", (8, 9)), ("ground", (0,)),
            ("time", (0,)),
        ):  # fmt: skip
            for _ in range(100):
                thing, finish = random.integers(len(OBJECTS)), random.choice(finishes)
                colors = (-1, -1) if kind == "material" else random.integers(11, size=2)
                look = np.array([finish, *colors, random.integers(7), random.integers(4)])
                check_words("small-plain", instruction(kind, thing, look, random))
                if kind != "pattern":
                    check_words("small-plain", ambiguous_instruction(kind, thing, random))
    for text in ("Add a hat", "remove the bear", "make it fly", "mach den Bären grün"):
        with pytest.raises(InputError, match="names no color, material, pattern, ground or time"):
            check_words("small-plain", text)
        with pytest.warns(InputWarning):
            check_words("small-plain", text, anyway=True)
    check_words("small-depth", "a bear")  # describes the edited scene


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("small-plain", torch.bfloat16),
        pytest.param("small-plain", torch.float16, marks=pytest.mark.slow),
    ],
)
def test_half_precision_changes_an_edit_by_less_than_40_db(name, dtype):
    """Oracle: the same edit in float32."""
    ramp = np.linspace(0, 1, 32, dtype=np.float32)
    picture = np.stack(
        [np.broadcast_to(ramp, (32, 32)), np.full((32, 32), 0.4), ramp[:, None] + 0 * ramp], -1
    )
    whole, half = (
        edit(load_editor(name, dtype=each), [picture], "make it red", steps=4).images[0]
        for each in (torch.float32, dtype)
    )
    assert np.abs(whole - picture).max() > 0.1
    assert -10 * np.log10(np.square(whole - half).mean()) > 40


def test_noise_pooled_over_a_region_is_white_there_and_hears_nothing_outside():
    """Oracle: the weighted sum in loops, and the variance of many white noises."""
    unet = load_editor("small-plain").unet
    region = torch.zeros(2, 8, 8)
    region[0, 2:5, 3:6], region[0, 5, 3] = 1, 0.5
    noises = torch.randn(4000, 48, 8, 8, generator=torch.Generator().manual_seed(0))
    unet.region = region
    pooled = unet._pooled(noises)
    by_hand = (
        sum(float(region[0, i, j]) * noises[0, :, i, j] for i in range(8) for j in range(8))
        / float(region[0].square().sum()) ** 0.5
    )
    assert torch.allclose(pooled[0], by_hand, atol=1e-5)
    assert abs(float(pooled[0::2].var()) - 1) < 0.02  # views take turns in a batch
    changed = noises.clone()
    changed[0, :, 6:] += 5
    assert torch.equal(unet._pooled(changed)[0], pooled[0])
    # Where nothing is edited the whole picture counts, as it does without a region.
    unet.region = None
    assert torch.allclose(unet._pooled(noises)[1], pooled[1], atol=1e-5)


def test_an_open_instruction_hears_the_noise_inside_the_mask_alone():
    """Oracle: the same edit of a network whose draw adds nothing."""
    picture = np.full((32, 32, 3), 0.5, np.float32)
    mask = np.zeros((32, 32), np.float32)
    mask[8:24, 8:24] = 1
    first = torch.randn(1, 48, 8, 8, generator=torch.Generator().manual_seed(1))
    second = first.clone()
    second[:, :, :2] = torch.randn(1, 48, 2, 8, generator=torch.Generator().manual_seed(2))

    def drawn(noise, **more):
        heard = []
        editor = load_editor("small-plain")
        editor.unet.draw.register_forward_hook(lambda net, args, out: heard.append(args[0][0, :48]))
        edit(editor, [picture], "make it another color", steps=1, noise=noise, **more)
        return heard[0]

    assert torch.equal(drawn(first, regions=[mask]), drawn(second, regions=[mask]))
    assert not torch.allclose(drawn(first), drawn(second), atol=0.1)


def test_an_editor_without_its_draw_is_an_option():
    assert load_editor("small-plain", draws=False).unet.draw is None
    assert load_editor("small-plain").unet.draw is not None


def test_latents_are_an_orthonormal_transform_and_lose_nothing():
    basis = haar_basis().reshape(48, 48)
    assert torch.allclose(basis @ basis.T, torch.eye(48, dtype=torch.float64), rtol=0, atol=1e-12)
    coder = HaarLatents()
    x = 2 * torch.rand((2, 3, 20, 32), generator=torch.Generator().manual_seed(0)) - 1
    latents = coder.encode(x).latents
    assert latents.shape == (2, 48, 5, 8)
    assert torch.allclose(coder.decode(latents).sample, x, rtol=0, atol=1e-5)
    even = coder.encode(torch.full((1, 3, 4, 4), 0.5)).latents[0, :, 0, 0]
    # Grey: sqrt(3) in luminance, 4 for the sum over 16 px of amplitude 1 / 4, half by the gain.
    assert even[0] == pytest.approx(0.5 * 3**0.5 * 4 * 0.5)
    assert torch.allclose(even[1:], torch.zeros(47), atol=1e-6)
    with pytest.raises(ValueError, match=r"x: got shape \(1, 3, 5, 8\)"):
        coder.encode(torch.zeros(1, 3, 5, 8))


def test_what_the_noise_draws_is_added_to_the_tokens_of_the_text():
    net = copy.deepcopy(load_editor("small-plain").unet).double()
    generator = torch.Generator().manual_seed(0)
    sample = torch.randn((2, 96, 8, 12), generator=generator).double()
    text = torch.randn((2, 5, 128), generator=generator).double()
    with torch.no_grad():
        result = net(sample, 885, encoder_hidden_states=text).sample
        # The mean of 96 cells has a standard deviation of 1 / sqrt(96).
        mean = sample[:, :48].flatten(2).sum(dim=2) / 96**0.5
        # Half of the way from where the answer is settled to where it is open.
        drawn = 0.5 * net.draw(torch.cat([mean, text[:, 4]], dim=1))
        draw, net.draw = net.draw, None
        expected = net(sample, 885, encoder_hidden_states=text + drawn[:, None]).sample
        assert torch.allclose(result, expected, rtol=0, atol=1e-10)
        assert not torch.allclose(result, net(sample, 885, text).sample, rtol=0, atol=1e-4)
        net.draw = draw
        late = net(sample, torch.tensor([850, 500]), text).sample
        net.draw = None
        assert torch.equal(late, net(sample, torch.tensor([850, 500]), text).sample)
