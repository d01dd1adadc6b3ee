"""Damaged folders of diffusion models: the model in the folder, or one line.

A failure is repeated by its label: the file and the seed of :mod:`damage_files`.
"""

import json
import struct

import damage_files
import numpy as np
import pytest
import tiny_editors
import torch
from torch_threads import on_one_thread

from attnwarp.editing.folder import load_controlnet, load_parts
from attnwarp.errors import InputError

FAST, SLOW = 4, 40

FILES = (
    "controlnet/diffusion_pytorch_model.safetensors",
    "text_encoder/model.safetensors",
    "text_encoder/config.json",
    "tokenizer/tokenizer.json",
    "scheduler/scheduler_config.json",
)


one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    tiny_editors.controlnet().save_pretrained(folder)
    return folder


def numbers_in(data):
    """All numbers of a safetensors file of float32, in order of size: after the length of a header
    and the header."""
    (length,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + length])
    assert {v["dtype"] for k, v in header.items() if k != "__metadata__"} == {"F32"}
    return np.sort(np.frombuffer(data[8 + length :], "<f4"))


def use(folder, name, data):
    (folder / name).write_bytes(data)
    if name.startswith("controlnet"):
        network = load_controlnet(folder / "controlnet", dtype=torch.float32)
    else:
        network = load_parts(folder, dtype=torch.float32)["text_encoder"]
    if name.endswith(".safetensors"):
        values = [
            v.numpy().ravel() for v in network.state_dict().values() if v.dtype.is_floating_point
        ]
        assert np.array_equal(np.sort(np.concatenate(values)), numbers_in(data), equal_nan=True)


def failures(folder, name, seeds):
    whole = (folder / name).read_bytes()
    try:
        use(folder, name, whole)
        return damage_files.failures(
            name, whole, lambda data: use(folder, name, data), seeds,
            refusals=(InputError,), text=name.endswith(".json"),
        )  # fmt: skip
    finally:
        (folder / name).write_bytes(whole)


@pytest.mark.parametrize("name", FILES)
@damage_files.seeds_of(FAST, SLOW)
def test_a_damaged_model_is_refused_in_one_line_or_is_that_of_its_files(folder, name, seeds):
    assert not (failed := failures(folder, name, seeds)), "\n".join(failed)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused_by_name(value, tmp_path):
    pipe = tiny_editors.pix2pix()
    pipe.unet.conv_in.weight.data[0, 0, 0, 0] = value
    pipe.save_pretrained(tmp_path)
    with pytest.raises(InputError, match=r"unet: its weights have NaN or inf.* in conv_in\.weight"):
        load_parts(tmp_path, dtype=torch.float32)
