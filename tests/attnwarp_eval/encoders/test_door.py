"""Encoders by name: what is known without loading anything, and what is said of a wrong name."""

import pytest
from imported_modules import modules_after

from attnwarp import encoders as library
from attnwarp.errors import InputError
from attnwarp_eval import encoders


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


def test_the_library_knows_the_encoders_of_edits_alone():
    with pytest.raises(
        InputError,
        match="unknown.* Known are clip-small, clip-parts, perceptual-small, lpips:FILE_OR_FOLDER$",
    ):
        library.load_encoder("dinov2:/models/x")


def test_the_door_itself_loads_nothing_heavy():
    modules = modules_after("from attnwarp_eval.encoders import kind_of; kind_of('clip:x')")
    assert "attnwarp_eval.encoders" in modules
    assert not modules & {"torch", "transformers", "PIL", "cv2", "scipy"}
