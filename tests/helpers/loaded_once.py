"""Fixtures for tests of commands: what they read from folders is made and read once."""

import functools

import pytest
from tiny_segmenters import save_dino, save_sam

from attnwarp.command.page import turntable
from attnwarp.editing import small


@pytest.fixture(autouse=True, scope="module")
def editors_are_loaded_once():
    """Reading a folder takes nearly half of the time of a command on a tiny editor."""
    load = functools.cache(small.load_editor)
    with pytest.MonkeyPatch.context() as patch:
        for place in ("attnwarp.editing.small", "attnwarp.command.edit"):
            patch.setattr(f"{place}.load_editor", load)
        yield


@pytest.fixture(autouse=True, scope="module")
def short_orbit():
    """The page's orbit takes most of a page's time; tests of its own look at all of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turntable, "FRAMES", 4)
        yield


@pytest.fixture(scope="session")
def segmenter_folders(tmp_path_factory):
    """Folders of a random Grounding DINO and SAM."""
    place = tmp_path_factory.mktemp("segmenters")
    save_dino(place / "dino")
    save_sam(place / "sam", seed=2)
    return place / "dino", place / "sam"
