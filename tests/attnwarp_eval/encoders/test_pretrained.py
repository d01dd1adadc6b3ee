"""CLIP and DINOv2 from folders as transformers writes them, held against transformers itself."""

import json
import shutil
import socket

import numpy as np
import pytest
import tiny_models
import torch
from safetensors.torch import load_file, save_file
from torch_threads import on_one_thread

from attnwarp.encoders import ImageEncoder, TextImageEncoder
from attnwarp.errors import InputError
from attnwarp_eval.encoders import TokenEncoder, load_encoder
from attnwarp_eval.encoders.preprocessing import read_preprocessing

TEXTS = ["a photo of a bear", "A  Bear, in\tthe forest!", "ünïcode 熊 42", ""]


@pytest.fixture(scope="module", autouse=True)
def no_network():
    """Nothing may ask for anything, not even for a name."""

    def refuse(*arguments, **more):
        raise AssertionError(f"asked the network for {arguments}")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket, "getaddrinfo", refuse)
        patch.setattr(socket.socket, "connect", refuse)
        yield


one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    return folder, *tiny_models.save_clip(folder)


@pytest.fixture(scope="module")
def clip(clip_folder):
    return load_encoder(f"clip:{clip_folder[0]}", "clip")


@pytest.fixture(scope="module", params=[False, True], ids=["dinov2", "registers"])
def dino(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dino")
    model, _ = tiny_models.save_dino(folder, registers=request.param)
    return load_encoder(f"dinov2:{folder}", "dino"), model, folder


def pictures(count=11, seed=0):
    """Pictures of several shapes, and more than go through the network at a time."""
    random = np.random.default_rng(seed)
    return [
        random.integers(0, 256, (40 + 3 * (i % 4), 50, 3), dtype=np.uint8) for i in range(count)
    ]


def floating(images):
    return [(image / 255).astype(np.float32) for image in images]


def cosine(a, b):
    return (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)


def through(model_call, folder, images):
    """The network on what our preprocessing gives, one picture at a time: no batches, no float64 in
    between.
    """
    prepare = read_preprocessing(folder)
    with torch.no_grad():
        return np.stack(
            [model_call(torch.from_numpy(prepare(x))[None])[0].numpy() for x in floating(images)]
        )


def test_clip_s_pictures_are_transformers_own_but_for_its_rounding_to_8_bits(clip, clip_folder):
    _, model, processor, _ = clip_folder
    images = pictures()
    with torch.no_grad():
        expected = model.get_image_features(
            **processor(images, return_tensors="pt")
        ).pooler_output.numpy()
    got = clip.images(floating(images))
    assert got.shape == (11, 24) and got.dtype == np.float64
    assert cosine(got, expected).min() > 1 - 2e-5  # noise, all of whose pixels were rounded twice
    # The pictures differ by far more than that, or the line above would say nothing.
    assert cosine(got[:1], got[1:]).max() < 1 - 1e-3


def test_clip_s_pictures_are_exactly_the_network_s(clip, clip_folder):
    folder, model, *_ = clip_folder
    expected = through(
        lambda x: model.get_image_features(pixel_values=x).pooler_output, folder, pictures()
    )
    np.testing.assert_allclose(
        clip.images(floating(pictures())), expected, rtol=0, atol=2e-5
    )  # float32, lengths of 2


def test_clip_s_texts_are_transformers_own(clip, clip_folder):
    _, model, _, tokenizer = clip_folder
    with torch.no_grad():
        # Padded in one batch, as users call it: what stands behind the end of a text must not
        # matter.
        inputs = tokenizer(TEXTS, padding=True, truncation=True, max_length=24, return_tensors="pt")
        expected = model.get_text_features(**inputs).pooler_output.numpy()
    got = clip.texts(TEXTS)
    assert got.shape == (4, 24) and got.dtype == np.float64
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-5)


def test_vocabulary_and_merges_do_as_well_as_one_file(clip, clip_folder, tmp_path):
    vocab, merges = tiny_models.tokens()
    shutil.copytree(clip_folder[0], tmp_path / "old")
    (tmp_path / "old" / "tokenizer.json").unlink()
    (tmp_path / "old" / "vocab.json").write_text(json.dumps(vocab), encoding="utf-8")
    (tmp_path / "old" / "merges.txt").write_text(
        "#version: 0.2\n" + "\n".join(" ".join(pair) for pair in merges) + "\n", encoding="utf-8"
    )
    assert np.array_equal(load_encoder(f"clip:{tmp_path / 'old'}").texts(TEXTS), clip.texts(TEXTS))


def test_a_long_text_is_cut_and_still_ends_where_it_is_read(clip, clip_folder):
    _, model, _, tokenizer = clip_folder
    long = "bear " * 40
    with torch.no_grad():
        inputs = tokenizer([long], truncation=True, max_length=24, return_tensors="pt")
        expected = model.get_text_features(**inputs).pooler_output.numpy()
    np.testing.assert_allclose(clip.texts([long]), expected, rtol=0, atol=2e-5)
    assert clip.cut(long) == 42 - 24 and clip.cut("bear") == 0


def test_dino_gives_the_class_token_and_the_patches_in_their_places(dino):
    encoder, model, folder = dino
    registers = getattr(model.config, "num_register_tokens", 0)
    expected = through(lambda x: model(pixel_values=x).last_hidden_state, folder, pictures())
    got, grid = encoder.images(floating(pictures())), encoder.tokens(floating(pictures()))
    assert got.shape == (11, 32) and grid.shape == (11, 3, 3, 32) and grid.dtype == np.float64
    np.testing.assert_allclose(got, expected[:, 0], rtol=0, atol=2e-5)
    np.testing.assert_allclose(
        grid.reshape(11, 9, 32), expected[:, 1 + registers :], rtol=0, atol=2e-5
    )
    assert cosine(got[:1], got[1:]).max() < 1 - 1e-4


def test_a_patch_of_the_grid_answers_to_its_own_place(dino):
    encoder, *_ = dino
    plain = np.full((48, 48, 3), 0.5, np.float32)
    marked = plain.copy()
    marked[3:10, 33:40] = 1  # after the crop to 42: patch row 0, column 2
    change = np.linalg.norm(encoder.tokens([marked])[0] - encoder.tokens([plain])[0], axis=-1)
    assert np.unravel_index(change.argmax(), change.shape) == (0, 2)


def test_empty_lists_give_no_rows(clip, dino):
    assert clip.images([]).shape == (0, 24) and clip.texts([]).shape == (0, 24)
    assert dino[0].images([]).shape == (0, 32) and dino[0].tokens([]).shape == (0, 3, 3, 32)


def test_half_and_double_precision_pictures_are_welcome(clip):
    image = floating(pictures(1))[0]
    expected = clip.images([image])
    assert np.array_equal(clip.images([image.astype(np.float64)]), expected)
    assert cosine(clip.images([image.astype(np.float16)]), expected) > 1 - 1e-5


def test_half_precision_weights_compute_in_float32(clip_folder, clip, tmp_path):
    folder, model, *_ = clip_folder
    shutil.copytree(folder, tmp_path / "half")
    import copy

    copy.deepcopy(model).half().save_pretrained(tmp_path / "half")
    half = load_encoder(f"clip:{tmp_path / 'half'}")
    got, expected = half.images(floating(pictures(2))), clip.images(floating(pictures(2)))
    assert cosine(got, expected).min() > 1 - 1e-5
    assert not np.array_equal(got.astype(np.float16), got)  # the results are not halves


def test_what_they_say_of_themselves(clip, clip_folder, dino):
    import hashlib

    about = clip.about
    assert (about.name, about.kind, about.size, about.dim) == (
        f"clip:{clip_folder[0]}",
        "clip",
        32,
        24,
    )
    weights = (clip_folder[0] / "model.safetensors").read_bytes()
    assert about.weights_sha256 == hashlib.sha256(weights).hexdigest() and about.source == str(
        clip_folder[0]
    )
    assert "shorter edge to 32 px (bicubic" in about.preprocessing
    assert json.loads(json.dumps(about.to_dict()))["dim"] == 24
    assert (dino[0].about.kind, dino[0].about.size, dino[0].about.dim) == ("dino", 42, 32)
    assert (
        isinstance(clip, TextImageEncoder)
        and isinstance(dino[0], ImageEncoder)
        and isinstance(dino[0], TokenEncoder)
    )


def test_weights_in_parts_and_in_the_old_format_are_found(clip_folder, clip, tmp_path):
    folder, model, *_ = clip_folder
    parts, old = tmp_path / "parts", tmp_path / "old"
    for place in (parts, old):
        shutil.copytree(folder, place)
        (place / "model.safetensors").unlink()
    model.save_pretrained(parts, max_shard_size="100KB")
    assert (
        not (parts / "model.safetensors").exists()
        and len(list(parts.glob("model-*.safetensors"))) > 1
    )
    torch.save(model.state_dict(), old / "pytorch_model.bin")
    expected = clip.images(floating(pictures(2)))
    for place in (parts, old):
        assert np.array_equal(load_encoder(f"clip:{place}").images(floating(pictures(2))), expected)
    next(parts.glob("model-*.safetensors")).unlink()
    with pytest.raises(InputError, match=r"index\.json names model-0000.*\.safetensors, not in"):
        load_encoder(f"clip:{parts}")


def edit(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def change_weights(folder, change):
    state = load_file(folder / "model.safetensors")
    change(state)
    save_file(state, folder / "model.safetensors", metadata={"format": "pt"})


def write_fewer_tokens(folder):
    """Another model's tokenizer, by which transformers would read every text at its first token,
    which is the same for all of them.
    """
    vocab, merges = tiny_models.tokens()
    fewer = {t: i for i, t in enumerate(t for t in vocab if t != "bear</w>")}
    tiny_models.CLIPTokenizer(vocab=fewer, merges=merges[:2]).save_pretrained(folder)


@pytest.mark.parametrize(
    "change, complaint",
    [
        (
            lambda f: shutil.rmtree(f),
            "there is no folder .*Place these files there: config.json, model.safetensors",
        ),
        (
            lambda f: (f / "config.json").unlink(),
            "has no config.json.*openai/clip-vit-large-patch14-336",
        ),
        (lambda f: (f / "config.json").write_text("{"), r"config\.json: not JSON"),
        (
            lambda f: edit(f / "config.json", model_type="dinov2"),
            "model_type 'dinov2', expected 'clip'",
        ),
        (
            lambda f: (f / "model.safetensors").unlink(),
            "no model.safetensors and no pytorch_model.bin.*hf download",
        ),
        (
            lambda f: (f / "model.safetensors").write_bytes(b"x" * 99),
            "cannot be loaded: .*fetch its files again",
        ),
        (lambda f: (f / "preprocessor_config.json").unlink(), "no preprocessor_config.json"),
        (
            lambda f: (f / "tokenizer.json").unlink(),
            "has no tokenizer.json, nor vocab.json with merges.txt",
        ),
        (lambda f: (f / "tokenizer.json").write_text("{}"), "not a tokenizer"),
        (
            lambda f: edit(f / "preprocessor_config.json", crop_size=40),
            r"gives \(40, 40\), the network .* \(32, 32\)",
        ),
        (
            lambda f: change_weights(f, lambda state: state.pop("text_projection.weight")),
            r"lacks 1 tensors that config.json calls for, text_projection\.weight first",
        ),
        (
            lambda f: change_weights(
                f, lambda state: state["visual_projection.weight"][3].fill_(np.nan)
            ),
            r"visual_projection\.weight in .* is NaN or infinite",
        ),
        (
            write_fewer_tokens,
            "has 516 tokens and ends a text with 515, the model .* knows 517 and expects 516",
        ),
    ],
)
def test_a_folder_that_will_not_do_is_refused_with_the_remedy(
    clip_folder, tmp_path, change, complaint
):
    folder = tmp_path / "clip"
    shutil.copytree(clip_folder[0], folder)
    change(folder)
    with pytest.raises(InputError, match=complaint) as caught:
        load_encoder(f"clip:{folder}")
    assert str(folder) in str(caught.value) and "://" not in str(caught.value)


@pytest.mark.door
@pytest.mark.parametrize(
    "bad, complaint",
    [
        (
            np.zeros((4, 4, 4), np.float32),
            r"images\[1\]: got shape \(4, 4, 4\), expected \(H, W, 3\)",
        ),
        (np.zeros((4, 4, 3), np.uint8), r"images\[1\]: got uint8, expected floating"),
        (
            np.full((4, 4, 3), 1.5, np.float32),
            r"images\[1\]: got values in \[1.5, 1.5\], expected \[0, 1\]",
        ),
        (np.full((4, 4, 3), np.nan, np.float32), r"images\[1\]: 48 values are NaN or infinite"),
        (np.full((4, 4, 3), 1e300), r"images\[1\]: got values in \[1e\+300"),
        (np.zeros((0, 4, 3), np.float32), "at least one pixel"),
    ],
)
def test_a_bad_picture_is_named(clip, bad, complaint):
    with pytest.raises(ValueError, match=complaint):
        clip.images([np.zeros((8, 8, 3), np.float32), bad])


@pytest.mark.door
def test_one_picture_or_text_instead_of_a_list_is_refused(clip, dino):
    with pytest.raises(TypeError, match="got one picture"):
        clip.images(np.zeros((8, 8, 3)))
    with pytest.raises(TypeError, match="got one string 'bear'"):
        clip.texts("bear")
    with pytest.raises(TypeError, match=r"texts\[0\]: got int"):
        clip.texts([3])


def _cubic(image, size):
    """Bicubic without antialiasing by its definition, in float64: Keys' kernel with a = -3/4, four pixels a side."""

    def kernel(x, a=-0.75):
        x = abs(x)
        if x <= 1:
            return (a + 2) * x**3 - (a + 3) * x**2 + 1
        return a * (x**3 - 5 * x**2 + 8 * x - 4) if x < 2 else 0.0

    def weights(old, new):
        rows = np.zeros((new, old))
        for k in range(new):
            at = (k + 0.5) * old / new - 0.5
            for n in range(int(np.floor(at)) - 1, int(np.floor(at)) + 3):
                rows[k, np.clip(n, 0, old - 1)] += kernel(at - n)
        return rows

    high, wide = (weights(o, n) for o, n in zip(image.shape, size, strict=False))
    return np.einsum("ih,hwc,jw->ijc", high, image.astype(np.float64), wide, optimize=True).clip(
        0, 1
    )


def test_the_authors_versions_see_whole_pictures_without_antialiasing(clip_folder, tmp_path):
    """Oracle: the kernel's definition before transformers' own network."""
    folder, model, processor, _ = clip_folder
    picture = np.random.default_rng(0).random((90, 130, 3)).astype(np.float32)
    encoder = load_encoder(f"clip-whole:{folder}", "clip")
    mean, std = (np.array(v) for v in (processor.image_mean, processor.image_std))
    seen = ((_cubic(picture, (32, 32)) - mean) / std).transpose(2, 0, 1)[None]
    with torch.no_grad():
        out = model.get_image_features(pixel_values=torch.from_numpy(seen).float())
    expected = getattr(out, "pooler_output", out).numpy()
    assert np.abs(encoder.images([picture]) - expected).max() < 1e-4
    assert np.abs(load_encoder(f"clip:{folder}").images([picture]) - expected).max() > 1e-3
    assert "not antialiased" in encoder.about.preprocessing

    network, config = tiny_models.save_dino(tmp_path, registers=True)
    encoder = load_encoder(f"dinov2-518:{tmp_path}", "dino")
    mean, std = (np.array(config[key]) for key in ("image_mean", "image_std"))
    seen = ((_cubic(picture, (518, 518)) - mean) / std).transpose(2, 0, 1)[None]
    with torch.no_grad():
        expected = network(pixel_values=torch.from_numpy(seen).float()).last_hidden_state[:, 0]
    assert encoder.tokens([picture]).shape[1:3] == (37, 37) and encoder.about.size == 518
    assert np.abs(encoder.images([picture]) - expected.numpy()).max() < 1e-4
