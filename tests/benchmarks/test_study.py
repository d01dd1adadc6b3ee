"""Part of a study that a stack belongs to, and that the parts name code that exists."""

from __future__ import annotations

import importlib.util

import pytest

from benchmarks import study


@pytest.mark.parametrize(
    ("stack", "part"),
    [
        (["attnwarp_eval.metrics.warp:error"], "metrics"),
        # Compilation counts as such, whatever asked for it.
        (["attnwarp.render.cpu:render", "numba.core.dispatcher:compile"], "compilation of kernels"),
        (["attnwarp_eval.world:splats", "attnwarp_eval.truth.raycast:cast"], "splats on surfaces"),
        (["attnwarp_eval.world:surface"], "truth: rays and correspondences"),
        (["attnwarp.warp.features:warp"], "features warped"),
        (["attnwarp.warp.rules:mask"], "positions and masks"),
        (["attnwarp.camera:project"], "the rest"),
    ],
)
def test_a_stack_belongs_to_the_first_part_that_names_one_of_its_functions(stack, part):
    """Outermost function first; the functions call each other for real."""

    def call(names):
        if not names:
            return study.part_of(study.sys._getframe())
        module, name = names[0].split(":")
        scope = {"__name__": module, "call": call, "rest": names[1:]}
        exec(f"def {name}(): return call(rest)", scope)
        return scope[name]()

    assert call(stack) == part


def test_the_parts_name_modules_that_exist():
    for _, beginnings in study.PARTS:
        for beginning in beginnings:
            module = beginning.partition(":")[0].rstrip(".")
            module = module.replace("importlib._bootstrap", "importlib")
            assert importlib.util.find_spec(module) is not None, beginning
