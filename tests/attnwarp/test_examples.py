"""The examples in the docstrings of the public doors run, and give what they say."""

import doctest
import importlib
import warnings

import pytest

MODULES = [
    "attnwarp.camera",
    "attnwarp.check",
    "attnwarp.errors",
    "attnwarp.gaussians",
    "attnwarp.losses",
    "attnwarp.fit.loop",
    "attnwarp.fit.settings",
    "attnwarp.fit.start",
    "attnwarp.fit.views",
    "attnwarp.io.dataset",
    "attnwarp.io.file",
    "attnwarp.io.folder",
    "attnwarp.io.images",
    "attnwarp.io.lens",
    "attnwarp.io.ply",
    "attnwarp.io.splat",
    "attnwarp.io.transforms",
    "attnwarp.io.undistort",
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some write a file
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = doctest.testmod(
            importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE
        )
    assert result.attempted > 0, "the module has no example"
    assert result.failed == 0
