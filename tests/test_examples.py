"""The examples of the docstrings and of the documents run, in a folder with what they name."""

import dataclasses
import doctest
import importlib
import inspect
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import small_capture
import torch

from attnwarp_eval.truth.mitsuba import build

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "attnwarp": ROOT / "attnwarp",
    "attnwarp_eval": ROOT / "eval" / "attnwarp_eval",
    "attnwarp_lab": ROOT / "eval" / "attnwarp_lab",
}


DOORS = [
    "attnwarp",
    "attnwarp.methods",
    "attnwarp.encoders",
    "attnwarp.fit",
    "attnwarp.io",
    "attnwarp.losses",
    "attnwarp.methods",
    "attnwarp.render",
    "attnwarp.warp",
    "attnwarp_eval.encoders",
    "attnwarp_eval.document.charts",
    "attnwarp_eval.document.model",
    "attnwarp_eval.document.numbers",
    "attnwarp_eval.document.write",
    "attnwarp_eval.metrics",
    "attnwarp_eval.report",
    "attnwarp_eval.scene.file",
    "attnwarp_eval.scene.scene",
    "attnwarp_eval.splats.export",
    "attnwarp_eval.splats.fitted",
    "attnwarp_eval.splats.surface",
    "attnwarp_eval.stability",
    "attnwarp_eval.statistics.equivalence",
    "attnwarp_eval.statistics.intervals",
    "attnwarp_eval.study",
    "attnwarp_eval.truth",
]
"""Modules that users' code imports from: what ``__all__`` names, else their own public names."""


def public(door):
    """The functions and classes of a door, by name."""
    module = importlib.import_module(door)
    names = getattr(module, "__all__", None)
    for name, value in sorted(vars(module).items()) if names is None else ():
        if not name.startswith("_") and getattr(value, "__module__", None) == door:
            yield name, value
    for name in names or ():
        yield name, getattr(module, name)


@pytest.mark.parametrize("door", DOORS)
def test_every_public_function_and_class_of_a_door_has_an_example(door):
    """The harness's results need none: its functions make them, and their attributes are listed."""
    values = {
        name: value
        for name, value in public(door)
        if inspect.isclass(value) or inspect.isroutine(value)
    }
    assert values, f"{door}: no public names"
    missing = [
        name
        for name, value in values.items()
        if not (door.startswith("attnwarp_eval") and dataclasses.is_dataclass(value))
        and not re.search(r"^ *Example:\n(?:.*\n)*? *>>> ", value.__doc__ or "", re.M)
    ]
    assert not missing, f"{door}: no example of {', '.join(missing)}"


def modules_with_examples():
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            if ">>> " in path.read_text():
                parts = path.relative_to(folder).with_suffix("").parts
                yield ".".join((package, *parts)).removesuffix(".__init__")


@pytest.fixture(scope="module")
def coarse_textures():
    """Textures for the examples' pictures of a few pixels, which print none of their values."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "TEXELS", 64)
        yield
        build.forget()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    small_capture.write(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("coarse_textures")
@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_of_the_docstrings_give_what_they_print(name, folder):
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner(
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.FAIL_FAST
    )
    output, finder = [], doctest.DocTestFinder(exclude_empty=True)
    of_module = finder._from_module  # which takes a decorated function for one of its decorator
    finder._from_module = lambda module, value: of_module(module, inspect.unwrap(value))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for example in finder.find(module, name):
            runner.run(example, out=output.append)
    assert runner.failures == 0, "".join(output)
    assert runner.tries > 0, f"{name}: no example ran"


NAMES = {
    "docs/truth/scenes.md": f"""
import shutil
shutil.copy({str(ROOT / "docs/truth/shapes.yaml")!r}, ".")
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.truth import Geometry
from attnwarp_eval.truth.edits import edit_mask
""",
    "docs/measuring/metrics.md": """
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.truth import Geometry
random = np.random.default_rng(0)
image_srgb, target_srgb, truth_srgb, original = random.uniform(size=(4, 32, 32, 3))
source_srgb = target_srgb
mask = np.zeros((32, 32), bool)
mask[8:24, 8:24] = True
edited_views, rendered_views = {"0": image_srgb}, {"0": target_srgb}
scene = load_scene("spheres")
geometry = Geometry(scene)
source, target = (camera.resize(32, 32) for camera in scene.cameras[:2])
originals = list(np.random.default_rng(0).random((3, 64, 64, 3)))
edited = [1 - picture for picture in originals]
from few_splats import few_splats
splats = few_splats()
from attnwarp import Camera
size = {"width": 64, "height": 64, "fov_y": 60}
cameras = [Camera.look_at((x, -4, 0), (0, 0, 0), **size) for x in (0, 1, 2)]
source_xy = target_xy = np.array([[32.0, 32.0]])
""",
    "docs/measuring/bench.md": "my_matcher = None",
    "docs/method/algorithm.md": """
source_picture = target_picture = np.random.default_rng(0).random((64, 64, 3), np.float32)
view = None
""",
    "docs/method/warping.md": """
from attnwarp.io import read_dataset, read_ply
gaussians = read_ply("scene.ply")
source, target = read_dataset("my_capture").cameras[:2]
source_features = torch.rand(8, 64, 64)
source_tokens, own_tokens = torch.rand(2, 1, 64 * 64, 8)
""",
}
"""Code that a page's blocks take for granted. Blocks of pages that are not here run as they are."""

NOT_RUN = {
    "docs/measuring/your-images.md": "weights of the user's own",
    "docs/project/extending.md": "registers a method for the rest of the process",
    "docs/method/fitting.md": "3000 iterations",
    "docs/method/editing-a-scene.md": "weights of the user's own",
}


def blocks(page):
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.M | re.S)


PAGES = [
    "README.md",
    *sorted(f"{path.relative_to(ROOT)}" for path in (ROOT / "docs").rglob("*.md")),
]


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page) and page not in NOT_RUN])
def test_examples_of_the_documents_run(page, folder):
    names = {"torch": torch, "np": np, "__name__": "example"}
    exec(NAMES.get(page, ""), names)
    for block in blocks(page):
        exec(compile(block, page, "exec"), names)


@pytest.mark.parametrize("page", NOT_RUN)
def test_examples_that_do_not_run_are_python(page):
    assert blocks(page)
    for block in blocks(page):
        compile(block, page, "exec")
        for line in re.findall(r"^from (attnwarp\S*) import (.+)$", block, re.M):
            module = importlib.import_module(line[0])
            assert all(hasattr(module, name.strip()) for name in line[1].split(","))
