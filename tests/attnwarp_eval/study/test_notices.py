"""Notices of what a mesh file leaves out, or has turned inside out: said once, and in the
report.
"""

import warnings

import pytest
import trimesh
import yaml
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.notices import notices
from attnwarp_eval.scene.shapes import MeshNotice

INWARD = "its faces look inward, so that it gets no splats"
SCENE = {
    "name": "own",
    "title": "A ball that is turned inside out, over a floor",
    "objects": [
        {
            "name": "ball",
            "shape": {"type": "mesh", "file": "ball.ply"},
            "texture": {"type": "checker", "colors": ["#ffffff", "#202020"], "size": 0.3},
        },
        {
            "name": "floor",
            "shape": {"type": "rectangle", "center": [0, 0, -1], "size": [6, 6]},
            "texture": {"type": "plain", "color": "#808080"},
        },
    ],
    "lights": [{"type": "sky", "horizon": "#cfdcea", "zenith": "#6f9fd8", "radiance": 1.0}],
    "cameras": {
        "look_at": [0, 0, 0], "radius": 4, "fov": 46,
        "source": {"yaw": 0, "height": 1.5}, "targets": [{"yaw": 30, "height": 1.5}],
    },
}  # fmt: skip
STUDY = {
    "name": "mine", "size": 16, "scenes": ["own.yaml"], "views": ["yaw030"], "feature_sizes": [16],
    "spp": 1, "splats": {"count": 200}, "variants": {"corrected": {"preset": "corrected"}},
    "probes": {"depth": ["corrected"], "warp": ["corrected"]},
}  # fmt: skip


@pytest.fixture
def place(tmp_path, monkeypatch):
    ball = trimesh.creation.icosphere(2)
    ball.invert()
    ball.export(tmp_path / "ball.ply")
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(SCENE))
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(STUDY))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_scene_has_a_line_for_each_thing_and_the_meshes_of_others_have_none(place):
    with pytest.warns(MeshNotice, match=INWARD):
        scene = load_scene(place / "own.yaml")
    with warnings.catch_warnings(action="error"):
        inward, texture = notices(scene)
    assert inward.startswith("ball.ply: 320 polygons in") and INWARD in inward
    assert texture.startswith("object 'ball': its pictures miss the texture by an albedo of")
    with warnings.catch_warnings(action="error"):
        assert notices(load_scene("spheres")) == []


@pytest.mark.parametrize("command", ["run", "run --dry-run"])
def test_a_run_says_it_once_and_its_report_has_it(place, command):
    runner = CliRunner()
    done = runner.invoke(app, [*command.split(), "mine.yaml", "--out", "run"])
    assert done.stderr.count(INWARD) == 1 and "MeshNotice" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if INWARD in line]
    assert line.startswith("attnwarp-eval: warning: scene own: ball.ply: 320 polygons in")
    if "--dry-run" in command:
        return
    for name in ("report.md", "report.html"):
        assert (place / "run" / name).read_text().count(INWARD) == 1
    assert runner.invoke(app, ["verify", "run"]).exit_code == 0
