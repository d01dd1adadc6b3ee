"""The examples of the docstrings, run."""

import doctest
import importlib

import pytest


@pytest.mark.parametrize("name", ["attention", "schedule", "controlnet", "latents"])
def test_examples_run(name):
    module = importlib.import_module(f"attnwarp.editing.{name}")
    result = doctest.testmod(module)
    assert result.attempted > 0
    assert result.failed == 0
