"""Damaged safetensors: the tensors that the file holds, or one line.

A failure is repeated by its label: the name of the reader and the seed of :mod:`damage_files`.
"""

import json
import shutil
import struct

import damage_files
import numpy as np
import pytest
import tiny_models
import torch
from safetensors.torch import save_file
from torch_threads import on_one_thread

from attnwarp.encoders import load_encoder
from attnwarp.encoders._weights import state_of
from attnwarp.encoders.bundled import WEIGHTS, load
from attnwarp.errors import InputError

FAST, SLOW = 6, 120

TYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "U8": "u1"}


one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def tensors_in(data):
    """By name, as the format's description has it: the length of a header, the header in JSON, and
    the numbers. Those of other types are left out."""
    (length,) = struct.unpack_from("<Q", data)
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    return {
        name: np.frombuffer(body[slice(*entry["data_offsets"])], TYPES[entry["dtype"]]).reshape(
            entry["shape"]
        )
        for name, entry in header.items()
        if name != "__metadata__" and entry["dtype"] in TYPES
    }


class State:
    """The file of an LPIPS backbone, and whatever else holds a state dict."""

    def __init__(self, folder):
        generator = torch.Generator().manual_seed(0)
        self.path = folder / "weights.safetensors"
        state = {
            "features.0.weight": torch.randn(8, 3, 3, 3, generator=generator),
            "features.0.bias": torch.randn(8, generator=generator).half(),
            "steps": torch.arange(5),
        }
        save_file(state, self.path)

    def use(self, data):
        state = state_of(self.path)
        for name, value in tensors_in(data).items():
            assert np.array_equal(state[name].numpy(), value, equal_nan=True), name


class Bundled:
    """Weights that a card names: any damage is seen."""

    def __init__(self, folder):
        self.folder = folder
        for path in WEIGHTS.glob("perceptual-small*"):
            shutil.copy(path, folder)
        self.path = folder / "perceptual-small.safetensors"

    def use(self, data):
        load("perceptual-small", self.folder)
        assert data == (WEIGHTS / self.path.name).read_bytes(), "damage was not seen"


class Pretrained:
    """A folder as transformers writes it: the network has the numbers of the file."""

    def __init__(self, folder):
        tiny_models.save_dino(folder, registers=False)
        self.folder = folder
        self.path = folder / "model.safetensors"

    def use(self, data):
        encoder = load_encoder(f"dinov2:{self.folder}", "dino")
        # transformers has other names in memory than in files: all numbers, in order of size.
        loaded = [value.numpy().ravel() for value in encoder._model.state_dict().values()]
        stored = [value.astype(np.float32).ravel() for value in tensors_in(data).values()]
        assert np.array_equal(np.sort(np.concatenate(loaded)), np.sort(np.concatenate(stored)))


READERS = {"state": State, "bundled": Bundled, "pretrained": Pretrained}


def failures(name, folder, seeds):
    reader = READERS[name](folder)
    whole = reader.path.read_bytes()
    reader.use(whole)

    def read(data):
        reader.path.write_bytes(data)
        reader.use(data)

    return damage_files.failures(name, whole, read, seeds, refusals=(InputError,))


@pytest.mark.parametrize("name", READERS)
@damage_files.seeds_of(FAST, SLOW)
def test_damaged_weights_are_refused_in_one_line_or_are_those_of_the_file(tmp_path, name, seeds):
    assert not (failed := failures(name, tmp_path, seeds)), "\n".join(failed)
