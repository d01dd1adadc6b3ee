"""The tasks of docs/project/extending, each as a diff that is applied to a copy and run there.

Each touches at most two files of the packages. What a copy computes is held against a closed form,
or against the method without the change.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DIFFS = ROOT / "docs/project/extending"
PAGE = ROOT / "docs/project/extending.md"
MOST_FILES = {"schedule": 1, "editor": 1, "probe": 1}
"""Files of the packages that a task touches; two for the others."""

EDITED = """
import importlib, math, sys
import numpy as np
from tiny_scenes import cameras, splats
from attnwarp.editing.small import load_editor
from attnwarp.methods import METHODS, preset

module = importlib.import_module("attnwarp.methods.algorithms.attention_warping")
weights, inject = [], module.inject

def noted(*values, weight, **more):
    weights.append(weight)
    return inject(*values, weight=weight, **more)

module.inject = noted

def edited(method="attention_warping", **changes):
    settings = preset(method, steps=3, iterations=0, **changes)
    scene, views = splats(), cameras(2)
    result = METHODS[method](scene, views, None, load_editor("small-plain"), "red", settings)
    return result.edited
"""

TASKS = {
    "schedule": EDITED
    + """
constant = edited(decay="constant")
cosine = edited()
for t in range(8):
    assert math.isclose(weights[-1](t, 8), 0.9 * math.cos(math.pi * t / 16) ** 2)
assert (cosine[0] == constant[0]).all() and (cosine[1] != constant[1]).any()
""",
    "last-steps": EDITED
    + """
# Without its last two of three steps, the injection is the first step's alone.
last, first, none = (
    edited(**changes)[1]
    for changes in ({"last_steps_alone": 2}, {"feature_steps": (0.0, 0.3)}, {"a0": 0.0})
)
assert (last == first).all() and (last != none).any()
assert (edited(last_steps_alone=3)[1] == none).all()
""",
    "rule": """
import numpy as np
from attnwarp import Camera
from attnwarp.warp import Surface, preset, warp_surfaces

# A wall across the axis: a pixel sees it at the angle of its ray from the axis.
camera = Camera(np.array([[20.0, 0, 16], [0, 20, 16], [0, 0, 1]]), np.eye(4), 32, 32)
wall = Surface(np.full((32, 32), 2.0), np.broadcast_to([0.0, 0, 1], (32, 32, 3)))
x, y = np.moveaxis(camera.pixel_centers() - 16, -1, 0) / 20
angle = np.degrees(np.arctan(np.hypot(x, y)))
for backend in ("auto", "reference"):
    settings = preset("corrected", target_incidence=30.0)
    view = warp_surfaces(camera, camera, wall, wall, settings, backend=backend)
    assert (view.rules["target_incidence"].numpy() == (angle <= 30)).all()
    assert (view.mask.numpy() == (angle <= 30)).all() and 0.1 < view.mask.double().mean() < 0.9
    plain = warp_surfaces(camera, camera, wall, wall, preset("corrected"), backend=backend)
    assert "target_incidence" not in plain.rules and plain.mask.all()
""",
    "metric": """
import json, subprocess, sys
import numpy as np
from attnwarp_eval import metrics

exact = np.zeros((4, 4, 2))
moved = exact.copy()
moved[1, 2] = [3, 4]
figures = metrics.endpoint_error(moved, exact, np.ones((4, 4), bool))
assert figures["warp.epe_max"] == 5 and metrics.METRICS["warp.epe_max"].unit == "px"
study = {
    "name": "own", "size": 32, "scenes": ["spheres"], "views": ["yaw030"], "spp": 1,
    "splats": {"count": 500}, "feature_sizes": [8],
    "variants": {"plain": {}, "slipped": {"set": {"pixel_centers": "integer"}}},
    "probes": {"warp": ["plain", "slipped"]},
    "ablations": [{"title": "Slip", "probe": "warp", "baseline": "plain", "variants": ["slipped"]}],
}
json.dump(study, open("own.yaml", "w"))
subprocess.run([sys.executable, "-m", "attnwarp_eval", "run", "own.yaml", "--out", "run"], check=True)
rows = [row for row in map(json.loads, open("run/results.jsonl")) if row["variant"] == "plain"]
found = {row["metric"]: row["value"] for row in rows if row["metric"].startswith("warp.epe_")}
assert found["warp.epe_max"] >= found["warp.epe_p95"] > 0
subprocess.run([sys.executable, "-m", "attnwarp_eval", "report", "run", "--long"], check=True)
lines = [line.split("|") for line in open("run/report.md")]
(head,) = [k for k, cells in enumerate(lines) if " EPE max " in cells]
shown = lines[head + 2][lines[head].index(" EPE max ")].split()[0]
assert lines[head + 2][1].strip() == "plain" and abs(float(shown) / found["warp.epe_max"] - 1) < 0.02
""",
    "picture-metric": """
import json, subprocess, sys
import numpy as np
from attnwarp_eval.files import write_picture

for name, value in (("renders", 51), ("edited", 0)):
    picture = np.zeros((16, 16, 3), np.uint8)
    picture[3, 4, 1] = value
    write_picture(__import__("pathlib").Path(name) / "a.png", picture)
command = [sys.executable, "-m", "attnwarp_eval", "metrics", "--renders=renders", "--edited=edited"]
subprocess.run([*command, "--perceptual=none", "--out=out"], check=True)
row = json.load(open("out/metrics.json"))["metrics"]["image.largest"]
assert abs(row["value"] - 51 / 255) < 1e-6
assert "Largest difference" in open("out/metrics.md").read()
""",
    "probe": """
import json, subprocess, sys
import numpy as np
from attnwarp_eval.scene.file import load_scene

study = {
    "name": "own", "size": 16, "scenes": ["spheres"], "views": ["yaw030", "yaw090"], "spp": 1,
    "variants": {"plain": {}}, "probes": {"turn": ["plain"]},
}
json.dump(study, open("own.yaml", "w"))
subprocess.run([sys.executable, "-m", "attnwarp_eval", "run", "own.yaml", "--out", "run"], check=True)
rows = map(json.loads, open("run/results.jsonl"))
(found,) = [row["views"] for row in rows if row["metric"] == "turn.angle"]
# All look at one point, from a circle: the sine of half the angle is half the chord of their rays.
spec = load_scene("spheres").spec.cameras
for name, angle in found.items():
    (target,) = [t for t in spec.targets if round(t.yaw - spec.source.yaw) == int(name[3:])]
    rays = []
    for view in (spec.source, target):
        yaw = np.radians(view.yaw)
        around = spec.radius * np.array([np.cos(yaw), np.sin(yaw)])
        ray = np.array([*around, view.height]) - np.array([0, 0, spec.look_at[2]])
        rays.append(ray / np.linalg.norm(ray))
    chord = np.linalg.norm(rays[0] - rays[1])
    assert abs(angle - np.degrees(2 * np.arcsin(chord / 2))) < 1e-6, (name, angle)
assert found.keys() == {"yaw030", "yaw090"}
assert "turn.angle" in open("run/report.md").read()
""",
    "editor": """
import json, subprocess, sys
from pathlib import Path
import numpy as np, torch
from tiny_scenes import cameras, pictures, splats
from attnwarp.editing.editor import edit
from attnwarp.editing.layers import hooked
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.editing.small import guide_of, load_editor
from attnwarp.methods import attention_warping, preset
from attnwarp.methods.algorithms.attention_warping import inject

Path("toy").mkdir(exist_ok=True)
Path("toy/model_index.json").write_text(json.dumps({"_class_name": "ToyPipeline"}))
editor = load_editor("toy")
assert guide_of("toy") == "picture" and editor.branches == ("text", "negative")
scene, views = splats(), cameras(3)
before = pictures(scene, views)

# The method runs on it as it is: the source is the editor's own edit, and a target takes from it.
def edited(**changes):
    settings = preset("attention_warping", stages=1, steps=3, iterations=0, **changes)
    return attention_warping(scene, views, None, editor, "red", settings)
whole, alone = edited(), edited(a0=0.0)
assert whole.counters["network_rows"] == 3 * 3 * 2
assert whole.counters["injected"] > 0.1
assert (whole.edited[0] == alone.edited[0]).all() and (whole.edited[1] != alone.edited[1]).any()
one = edited(blocks=[1], kinds=["joint"])
assert 2 * one.counters["feature_bytes"] == whole.counters["feature_bytes"]
assert (one.edited[1] != whole.edited[1]).any()

# Recording changes no bit; a view's own features at a = 1 change none; another text's do.
h, w = editor.noise_shape((32, 32))[1:]
plan = RecordingPlan(editor.layers(), (h, w), editor.carries, steps=3)
def red(words="red"):
    return edit(editor, before[:1], words, steps=3).latents
plain, other = red(), red("a blue bear")
with record(editor, plan) as recording:
    assert torch.equal(red(), plain)
assert recording.bytes == plan.bytes and len(recording.timesteps) == 3
with inject(editor, recording, weight=lambda t, T: 1.0):
    assert torch.equal(red(), plain)
    assert not torch.equal(red("a blue bear"), other)

# Tokens of the text and of the reference keep their bits, wherever they stand.
seen = {}
def note(name):
    def keep(module, args, output):
        seen[name] = output if isinstance(output, tuple) else args[0]
    return keep
def tokens(hook):
    seen.clear()
    with hooked(editor, editor.layers(), hook):
        handles = [
            editor.network.get_submodule(name).register_forward_hook(note(name))
            for name in ("pair", "stream.to_out")
        ]
        edit(editor, before[:1], "red", steps=1)
        [handle.remove() for handle in handles]
    return dict(seen)
ours, zeros = tokens(lambda *_: None), tokens(lambda layer, tokens, call: 0 * tokens)
image, text = zeros["pair"]
count, first = h * w, text.shape[1]
assert (image[:, :count] == 0).all() and (image[:, count:] == ours["pair"][0][:, count:]).all()
assert (text == ours["pair"][1]).all()
sequence = zeros["stream.to_out"]
assert (sequence[:, first : first + count, :16] == 0).all()
for rows in (slice(0, first), slice(first + count, None)):
    assert (sequence[:, rows, :16] != 0).any()
assert (sequence[:, first : first + count, 16:] != 0).any()

# The commands take it by its folder.
from attnwarp.io.images import encode_png
Path("a.png").write_bytes(encode_png(np.rint(255 * before[0]).astype(np.uint8)))
words = ["edit-image", "a.png", "--instruction", "red", "--editor", "toy", "--out", "b.png", "--steps", "2"]
subprocess.run([sys.executable, "-m", "attnwarp", *words], check=True)
assert Path("b.png").is_file()
""",
    "method": EDITED
    + """
from attnwarp.render import render
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS

assert "softened" in EDITING_METHODS
alone = edited("by_view")
for share in (0.0, 0.5, 1.0):
    softened = edited("softened", share=share)
    for k, camera in enumerate(cameras(2)):
        before = 255 * render(splats(), camera).color.clamp(0, 1).double().numpy()
        expected = before + share * (alone[k] - before)
        assert np.abs(softened[k] - expected).max() <= 1
    assert (alone[1] != np.rint(before)).any()
""",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_a_newcomers_task_touches_two_files_at_most_and_takes_effect(name, tmp_path):
    for package in ("attnwarp", "eval/attnwarp_eval", "eval/attnwarp_lab"):
        # With the compiled kernels beside the modules, which numba knows by their times.
        shutil.copytree(ROOT / package, tmp_path / package)
    diff = DIFFS / f"{name}.diff"
    count = subprocess.run(
        ["git", "apply", "--numstat", diff], capture_output=True, text=True, check=True
    )
    assert 1 <= len(count.stdout.splitlines()) <= MOST_FILES.get(name, 2)
    paths = [tmp_path, tmp_path / "eval", ROOT / "tests/helpers"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}

    def run(code):
        return subprocess.run(
            [sys.executable, "-c", code],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
        )

    where = run("import attnwarp, attnwarp_eval\nprint(attnwarp.__file__, attnwarp_eval.__file__)")
    assert all(Path(file).is_relative_to(tmp_path) for file in where.stdout.split()), where.stderr
    assert run(TASKS[name]).returncode != 0  # so it is the diff that makes it pass
    subprocess.run(["git", "apply", diff], cwd=tmp_path, check=True)
    done = run(TASKS[name])
    assert done.returncode == 0, done.stderr


def test_the_page_links_every_task():
    files = {path.stem for path in DIFFS.glob("*.diff")}
    assert files == TASKS.keys()
    assert all(f"(extending/{name}.diff)" in PAGE.read_text() for name in files)
