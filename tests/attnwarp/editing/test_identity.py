"""Oracles: other inputs have other digests, and the bytes that are hashed are counted."""

import hashlib
import json
import os
from types import SimpleNamespace

import pytest
import torch
from tiny_editors import pix2pix

from attnwarp.editing.editor import Editor
from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from attnwarp.editing.identity import editor_digest, file_digest, weights_digest


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


@pytest.fixture
def hashed(tmp_path, monkeypatch):
    """Counts of bytes that go through SHA-256, of which an empty folder of derived files knows
    none."""
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path / "cache"))
    counts, real = [0], hashlib.sha256

    class Counted:
        def __init__(self, data=b""):
            self.own = real(data)

        def update(self, data):
            counts[0] += len(data)
            self.own.update(data)

        def hexdigest(self):
            return self.own.hexdigest()

    monkeypatch.setattr(hashlib, "sha256", Counted)

    def of(editor):
        counts[0] = 0
        return editor_digest(editor), counts[0]

    return of


def test_the_weights_of_a_file_are_hashed_once(hashed, tmp_path):
    pipe = pix2pix()
    parts = (pipe.unet, pipe.vae, pipe.text_encoder)
    weights = sum(t.nbytes for part in parts for t in part.state_dict().values())
    folder = tmp_path / "model"
    pipe.save_pretrained(folder)
    first, count = hashed(InstructPix2Pix.from_folder(folder))
    assert count > weights
    again, count = hashed(InstructPix2Pix.from_folder(folder))
    assert again == first and count < weights / 4
    # The same weights made in memory have the same digest, and another file's have not.
    assert weights_digest(pipe.unet) == weights_digest(InstructPix2Pix.from_folder(folder).unet)
    with torch.no_grad():
        pipe.unet.conv_in.weight[-1, -1, -1, -1] += 1
    pipe.save_pretrained(folder)
    assert hashed(InstructPix2Pix.from_folder(folder))[0] != first
    assert weights_digest(pipe.unet) == weights_digest(InstructPix2Pix.from_folder(folder).unet)


@pytest.mark.parametrize("change", ["one value", "behind autograd", "a layer"])
def test_a_loaded_network_that_is_changed_has_another_digest(change, hashed, tmp_path):
    pix2pix().save_pretrained(tmp_path / "model")
    editor = InstructPix2Pix.from_folder(tmp_path / "model")
    first, _ = hashed(editor)
    with torch.no_grad():
        if change == "one value":
            editor.unet.conv_in.weight[-1, -1, -1, -1] += 1
        elif change == "behind autograd":
            editor.unet.conv_in.weight.data *= 2
        else:
            editor.unet.more = torch.nn.Linear(1, 1)
    assert hashed(editor)[0] != first


def test_a_file_is_hashed_once_until_it_changes(tmp_path, monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path / "cache"))
    path, reads, real = tmp_path / "weights", [], hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda *given: reads.append(1) or real(*given))
    for number, content in enumerate((b"abc", b"abd", b"abcd")):
        path.write_bytes(content)
        os.utime(path, ns=(number, number))
        expected = hashlib.sha256(content).hexdigest()
        reads.clear()
        assert [file_digest(path), file_digest(path)] == [expected] * 2
        assert len(reads) == 1
    path.write_bytes(b"abce")  # now: a further change could have the same time
    assert [file_digest(path) for _ in range(2)] == [hashlib.sha256(b"abce").hexdigest()] * 2
    assert len(reads) == 3
