"""Encoders by name: what is known without loading anything, and what is said of a wrong name."""

import importlib.util

import pytest
from imported_modules import modules_after

from attnwarp import encoders
from attnwarp.errors import InputError


@pytest.mark.parametrize(
    "name, kind",
    [
        ("clip-small", "clip"), ("dino-small", "dino"), ("perceptual-small", "perceptual"),
        ("clip:/x", "clip"), ("dinov2:x y/z", "dino"), ("lpips:C:/odd", "perceptual"),
    ],
)  # fmt: skip
def test_a_name_tells_the_kind(name, kind):
    assert encoders.kind_of(name) == kind


@pytest.mark.parametrize(
    "name, guess",
    [
        ("clipsmall", "'clip-small'"),
        ("dino:/models/x", "'dinov2:FOLDER'"),
        ("LPIPS:x", "'lpips:FILE_OR_FOLDER'"),
        ("perceptual", "'perceptual-small'"),
        ("Clip-Small", "'clip-small'"),
    ],
)
def test_a_name_that_is_nearly_right_is_guessed(name, guess):
    with pytest.raises(InputError, match=f"unknown; did you mean {guess}"):
        encoders.load_encoder(name)


def test_a_name_that_is_like_none_gets_the_list():
    with pytest.raises(
        InputError, match=r"encoder 'zzz': unknown\. Known are clip-small, .*lpips:FILE_OR_FOLDER"
    ):
        encoders.kind_of("zzz")
    with pytest.raises(InputError, match="no place behind the colon, expected clip:FOLDER"):
        encoders.kind_of("clip: ")


def test_another_kind_than_asked_for_is_refused_before_anything_is_loaded():
    with pytest.raises(
        InputError,
        match="is of kind 'dino', expected 'clip'; name one of clip-small, clip-parts, clip:FOLDER",
    ):
        encoders.load_encoder("dinov2:/nowhere", "clip")


def test_bundled_ones_are_described():
    assert list(encoders.available()) == [
        "clip-small",
        "clip-parts",
        "dino-small",
        "perceptual-small",
    ]
    assert all(encoders.available().values())


@pytest.mark.door
def test_an_installation_without_bundled_weights_says_so(monkeypatch):
    result = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *a: None if name.endswith("bundled") else result(name),
    )
    with pytest.raises(
        InputError, match="carries no bundled weights; name a real one: clip:FOLDER"
    ):
        encoders.load_encoder("clip-small")


def test_the_door_itself_loads_nothing_heavy():
    modules = modules_after("from attnwarp.encoders import kind_of; kind_of('clip:x')")
    assert "attnwarp.encoders" in modules
    assert not modules & {"torch", "transformers", "PIL", "cv2", "scipy"}
