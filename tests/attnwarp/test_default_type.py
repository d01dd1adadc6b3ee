"""Results in a process whose default type of numbers is float64, as some packages set it on import, whose
default device is no CPU, or whose gradients are off. The device meta stands for a GPU: it computes nothing.
"""

import ast
import functools
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scenes import cameras, pictures, splats
from torch_threads import on_one_thread

import attnwarp
from attnwarp.editing.small import load_editor
from attnwarp.fit import FitSettings, Views, fit, from_points
from attnwarp.methods import METHODS, preset

one_thread = pytest.fixture(on_one_thread, autouse=True, scope="module")

MAKERS = {"empty", "eye", "full", "linspace", "normal", "ones", "rand", "randn", "zeros"}
"""torch's functions whose result is of the default type unless one is named."""

PACKAGES = [Path(attnwarp.__file__).parent, *Path("eval").glob("attnwarp_*")]


@contextmanager
def float64():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def meta():
    torch.set_default_device("meta")
    try:
        yield
    finally:
        torch.set_default_device(None)


OTHER_PROCESSES = pytest.mark.parametrize(
    "process", [float64, meta, torch.no_grad, torch.inference_mode]
)


def same_splats(a, b):
    names = ("means", "quats", "scales", "opacities", "sh")
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in names)


def methods_but_one_at_the_door():
    for name in METHODS:
        yield pytest.param(name, marks=[pytest.mark.door] * (name != "attention_warping"))


@functools.cache
def edit_of(name):
    """Return what edits by a method, and its edit in a process of torch's own defaults."""
    model, views = splats(), cameras(3)
    images = pictures(model, views)
    settings = preset(name, steps=2, iterations=3, background="random")
    own = {}
    if name == "attention_warping":
        # Edited elsewhere: its noise is replayed.
        settings = settings.changed(stages=1, perceptual=1.0)
        own = {"source_picture": np.flip(images[0], axis=1).copy()}

    def edited():
        editor = load_editor("small-depth" if name == "gaussctrl" else "small-plain")
        return METHODS[name](model, views, images, editor, "make it red", settings, **own)

    return edited, edited()


@OTHER_PROCESSES
@pytest.mark.parametrize("name", methods_but_one_at_the_door())
def test_an_edit_has_the_same_bits_in_a_process_of_other_defaults(name, process):
    edited, first = edit_of(name)
    with process():
        again = edited()
    assert all(np.array_equal(again.edited[view], first.edited[view]) for view in first.edited)
    assert same_splats(again.gaussians, first.gaussians)


@functools.cache
def fit_of(kind):
    """Return what fits, and its fit in a process of torch's own defaults."""
    model, views = splats(), cameras()
    seen = Views(views, pictures(model, views))
    settings = FitSettings(
        kind=kind, iterations=12, sh_degree=1, background="random", densify_from=0.25,
        densify_least=4, densify_until=1, grow_gradient=1e-6, evaluate_every=6,
    )  # fmt: skip

    def fitted():
        colors = np.full((len(model), 3), 128, np.uint8)
        start = from_points(model.world_means(), colors, kind=kind, sh_degree=1)
        return fit(start, seen, settings).gaussians

    first = fitted()
    assert len(first) > len(model)  # densified, which draws
    return fitted, first


@OTHER_PROCESSES
@pytest.mark.parametrize("kind", ["2d", pytest.param("3d", marks=pytest.mark.door)])
def test_a_fit_has_the_same_bits_in_a_process_of_other_defaults(kind, process):
    fitted, first = fit_of(kind)
    with process():
        again = fitted()
    assert same_splats(again, first)


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_every_tensor_is_made_of_a_type_that_is_named(package):
    calls = [
        (path, node)
        for path in package.rglob("*.py")
        if "torch." in (text := path.read_text())
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) in {f"torch.{name}" for name in MAKERS}
    ]
    assert calls
    # A network's parameters are made anew in the type that its weights are read in.
    named = [any(word.arg in ("dtype", None) for word in node.keywords) for _, node in calls]
    missing = [
        f"{path}:{node.lineno}"
        for (path, node), right in zip(calls, named, strict=True)
        if not right and path.name not in {"nets.py", "dino_small.py"}
    ]
    assert not missing
