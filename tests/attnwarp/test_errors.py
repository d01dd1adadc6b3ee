import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from attnwarp.errors import EXTRAS, InputError, MissingExtraError, missing_extra, optional_imports

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "mapbox-earcut": "mapbox_earcut",
    "open3d-cpu": "open3d",
    "pyyaml": "yaml",
    "scikit-image": "skimage",
    "trame-vtk": "trame_vtk",
    "trame-vuetify": "trame_vuetify",
    "warp-lang": "warp",
}
"""Names on the package index that differ from the module's."""
BROUGHT_ALONG = {"drjit": "mitsuba"}
"""Modules that come with another package of the extra."""
NOT_IMPORTED_ALONE = {"libusb-package"}
"""Open3D works without it where the machine has libusb, so its absence is no error."""


def requirements(extra):
    lines = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    names = {re.split(r"[<>=\[]", line)[0] for line in lines[extra]}
    return names - {"attnwarp"} - NOT_IMPORTED_ALONE


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_extras_of_the_errors_are_those_of_the_package(extra):
    modules = {PACKAGES.get(name, name) for name in requirements(extra)}
    # tokenizers is in two extras, so that neither needs the other; the error names the first.
    modules -= {name for other in EXTRAS if other != extra for name in EXTRAS[other].modules}
    assert set(EXTRAS[extra].modules) - set(BROUGHT_ALONG) == modules


def test_a_missing_package_is_an_input_error_that_names_its_extra():
    named = pytest.raises(MissingExtraError, match=r"pip install -c constraints.txt -e '\.\[gpu\]'")
    with named as caught, optional_imports():
        raise ModuleNotFoundError("No module named 'warp'", name="warp")
    assert isinstance(caught.value, InputError)
    assert (caught.value.module, caught.value.extra) == ("warp", "gpu")


@pytest.mark.door
@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("No module named 'attnwarp.nothing'", name="attnwarp.nothing"),
        ImportError("libEGL.so.1: cannot open shared object file", name="open3d"),
    ],
)
def test_other_failed_imports_are_not_explained_away(error):
    assert missing_extra(error) is None
    with pytest.raises(type(error)) as caught, optional_imports():
        raise error
    assert caught.value is error


BLOCKED = """
import importlib.abc, sys

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
sys.argv = {argv}
from {package} import main
main()
"""


def run_without(modules, package, argv, cwd):
    code = BLOCKED.format(modules=set(modules), argv=argv, package=package)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "eval")])}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=cwd, env=environment
    )


@pytest.mark.door
@pytest.mark.parametrize(
    ("argv", "module", "extra"),
    [
        (["attnwarp-eval", "scenes", "list"], "pydantic", "eval"),
        (["attnwarp-eval", "run", "quick"], "pydantic", "eval"),
    ],
)
def test_a_command_without_its_extra_ends_in_one_line_and_code_2(argv, module, extra, tmp_path):
    every = [name for one in EXTRAS.values() for name in one.modules]
    done = run_without(every, "attnwarp_eval.cli.main", argv, tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stderr == (
        f"attnwarp-eval: needs the package {module}, which comes with the extra '{extra}';"
        f" in the checkout: pip install -c constraints.txt -e '.[{extra}]'\n"
    )


def test_help_of_both_commands_needs_no_extra(tmp_path):
    every = [name for one in EXTRAS.values() for name in one.modules]
    for package, name in (
        ("attnwarp.cli.main", "attnwarp"),
        ("attnwarp_eval.cli.main", "attnwarp-eval"),
    ):
        done = run_without(every, package, [name, "--help"], tmp_path)
        assert done.returncode == 0 and "Usage" in done.stdout, done.stderr
