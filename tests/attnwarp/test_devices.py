"""A GPU that this machine lacks is played by what torch says of it."""

import importlib.util

import pytest
import torch
from edit_folders import Watched

from attnwarp.devices import choose, device_of, type_of
from attnwarp.errors import InputError, MissingExtraError


@pytest.fixture
def gpu(monkeypatch):
    """A machine with a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a GPU")


@pytest.fixture
def without_warp(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "warp" else find(name)
    )


def test_auto_is_the_processor_where_there_is_no_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose("auto") == "cpu"
    with pytest.raises(InputError, match="device 'cuda': this machine or this torch has no CUDA"):
        choose("cuda")


def test_auto_is_the_gpu_where_there_is_one_and_says_so(gpu):
    said = []
    assert choose("auto", Watched(log=said.append)) == "cuda"
    assert said == ["on a GPU; --device cpu computes on the processor"]
    assert choose("cpu") == "cpu" and choose("cuda") == "cuda"


def test_splats_on_a_gpu_need_the_extra(gpu, without_warp):
    said = []
    assert choose("auto", Watched(log=said.append)) == "cpu"
    assert "splats on it need Warp" in said[0] and "'.[gpu]'" in said[0]
    with pytest.raises(MissingExtraError, match="extra 'gpu'"):
        choose("cuda")
    assert choose("cuda", splats=False) == "cuda"


def test_an_unknown_device_is_refused():
    with pytest.raises(InputError, match="device 'gpu': unknown, expected cpu or cuda"):
        device_of("gpu")


def test_an_unknown_precision_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match="dtype 'half': unknown, expected one of auto, float32"):
        type_of("half", "cpu")
