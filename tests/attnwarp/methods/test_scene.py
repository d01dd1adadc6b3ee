"""Oracles: the types' definitions of 1, memory addresses, hashlib."""

import hashlib
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tiny_editors import pix2pix
from tiny_scenes import cameras

from attnwarp import Camera
from attnwarp.editing.editor import Editor
from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from attnwarp.fit import Views
from attnwarp.methods.scene import Scene, editor_digest, images_of

RANDOM = np.random.default_rng(0)
BYTES = RANDOM.integers(0, 256, (32, 32, 3), dtype=np.uint8)
IMAGES = {
    "uint8": BYTES,
    "uint16": RANDOM.integers(0, 65536, (32, 32, 3), dtype=np.uint16),
    "float32": RANDOM.random((32, 32, 3), dtype=np.float32),
}


@pytest.mark.parametrize("kind", IMAGES)
def test_a_view_is_not_copied_and_is_read_as_float32(kind):
    given = IMAGES[kind]
    scene = Scene.checked(cameras(1), [given], None)
    assert np.shares_memory(scene.images[0], given)
    top = {"uint8": 255, "uint16": 65535, "float32": 1}[kind]
    picture = scene.picture(0)
    assert picture.dtype == np.float32
    assert np.array_equal(picture, (given / np.float64(top)).astype(np.float32))


def test_the_hash_of_views_is_that_of_their_float32_pictures():
    scene = Scene.checked(cameras(3), list(IMAGES.values()), None)
    expected = hashlib.sha256()
    for k in range(3):
        expected.update(b"float32(32, 32, 3)" + scene.picture(k).tobytes())
    assert scene.digest()["images"] == expected.hexdigest()
    assert json.dumps(scene.digest())


@pytest.mark.parametrize("image", ["read-only", "flipped"])
@pytest.mark.filterwarnings("error")
def test_an_image_that_torch_could_not_share_is_copied(image):
    given = IMAGES["float32"][..., ::-1] if image == "flipped" else IMAGES["float32"].copy()
    given.flags.writeable = image == "flipped"
    picture = Scene.checked(cameras(1), [given], None).picture(0)
    assert torch.equal(torch.from_numpy(picture), torch.tensor(given.tolist()))


def test_photographs_keep_their_type_and_transparent_ones_lie_over_black():
    view = Camera.look_at((0, 0, 3), (0, 0, 0), width=32, height=32, fov_y=40, up=(0, 1, 0))
    clear = np.dstack([BYTES, np.full((32, 32), 51, np.uint8)])  # a fifth
    opaque, over = images_of(Views([view, view], [BYTES, clear]))
    assert opaque is BYTES
    assert np.allclose(over, BYTES / 255 / 5, rtol=0, atol=1e-7)


def test_editors_of_other_guidance_have_other_digests_where_their_digits_read_alike():
    pipe = pix2pix()
    digests = {
        editor_digest(
            InstructPix2Pix(
                pipe.unet,
                pipe.vae,
                pipe.text_encoder,
                pipe.tokenizer,
                pipe.scheduler,
                text_guidance=text,
                image_guidance=image,
            )
        )
        for text, image in ((1.5, 12), (1.51, 2), (15, 12))
    }
    assert len(digests) == 3


def test_editors_of_another_schedule_scale_or_vocabulary_have_other_digests(tmp_path):
    pix2pix().save_pretrained(tmp_path)
    first = editor_digest(InstructPix2Pix.from_folder(tmp_path))
    assert editor_digest(InstructPix2Pix.from_folder(tmp_path)) == first
    for name, change in (
        ("scheduler/scheduler_config.json", {"timestep_spacing": "trailing"}),
        ("scheduler/scheduler_config.json", {"steps_offset": 0}),
        ("vae/config.json", {"scaling_factor": 0.5}),
        ("vae/config.json", {"norm_num_groups": 2}),
        ("unet/config.json", {"attention_head_dim": 8}),
        ("text_encoder/config.json", {"hidden_act": "gelu"}),
        ("tokenizer/tokenizer_config.json", {"pad_token": "a</w>"}),
        ("tokenizer/tokenizer_config.json", {"model_max_length": 20}),
    ):
        path = tmp_path / name
        before = path.read_text()
        path.write_text(json.dumps({**json.loads(before), **change}))
        assert editor_digest(InstructPix2Pix.from_folder(tmp_path)) != first, change
        path.write_text(before)
    same = tmp_path / "scheduler" / "scheduler_config.json"
    same.write_text(json.dumps({**json.loads(same.read_text()), "thresholding": False}))
    assert editor_digest(InstructPix2Pix.from_folder(tmp_path)) == first
    path = tmp_path / "tokenizer" / "tokenizer.json"
    words = json.loads(path.read_text())
    vocabulary = words["model"]["vocab"]
    one, other = sorted(vocabulary)[:2]
    vocabulary[one], vocabulary[other] = vocabulary[other], vocabulary[one]
    path.write_text(json.dumps(words))
    assert editor_digest(InstructPix2Pix.from_folder(tmp_path)) != first


def test_a_digest_does_not_change_when_texts_are_embedded_nor_need_more_than_the_protocol():
    pipe = pix2pix()
    own = InstructPix2Pix(pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler)
    first = editor_digest(own)
    own.embed(["a bear"])  # which leaves its padding in the tokenizer
    assert editor_digest(own) == first
    members = {name for kind in Editor.__mro__[:2] for name in vars(kind) if name[0] != "_"}
    bare = SimpleNamespace(**{name: getattr(own, name) for name in members.union(own.options)})
    assert len(editor_digest(bare)) == 64
    assert not hasattr(bare, "vae") and not hasattr(bare, "tokenizer")
