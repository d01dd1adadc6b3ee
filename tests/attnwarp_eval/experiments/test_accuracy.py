"""Measurement of the truth's own error and time, held to errors that are known."""

import json

import numpy as np
import pytest
from effect_scenes import FLOOR, PLAIN, SKY, SUN, ball, make
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.experiments import accuracy
from attnwarp_eval.experiments.accuracy import geometry, point_visibility
from attnwarp_eval.experiments.accuracy.panel import Contestant, Panel
from attnwarp_eval.experiments.accuracy.write import write
from attnwarp_eval.scene.file import load_scene

pytestmark = pytest.mark.usefixtures("coarse_textures")


def test_the_brute_force_finds_hits_known_in_closed_form():
    # A unit right triangle at z = 2 before one at z = 3: rays through the lower left half hit the
    # nearer.
    near = np.array([[0.0, 0, 2], [1, 0, 2], [0, 1, 2]])
    far = np.array([[-9.0, -9, 3], [9, -9, 3], [0, 18, 3]])
    origins = np.array([[0.2, 0.2, 0], [0.8, 0.8, 0], [0.2, 0.2, 0], [0.2, 0.2, 2.5], [50, 50, 0]])
    directions = np.array([[0, 0, 1.0], [0, 0, 1], [0, 0, 0.5], [0, 0, 1], [0, 0, 1]])
    endless = np.full(5, np.inf)
    t = geometry.every_triangle(origins, directions, np.stack([far, near]), endless)
    assert t.tolist() == [2.0, 3.0, 4.0, 0.5, np.inf]
    t = geometry.every_triangle(
        origins, directions, np.stack([far, near]), np.array([2.0, 3.5, 9, 0.1, 1])
    )
    assert t.tolist() == [3.0, 3.0, 4.0, np.inf, np.inf] or t.tolist() == [
        np.inf,
        3.0,
        4.0,
        np.inf,
        np.inf,
    ]


def test_the_error_of_a_picture_falls_with_the_square_root_of_its_samples():
    # Few light paths through fog are drawn independently, so four times the samples halve the
    # error; "everything on" sees the same.
    scene = make([FLOOR, ball()], [SUN, SKY], 4, medium={"sigma_t": 0.2, "albedo": 0.9, "g": 0.0})
    panel = accuracy.pictures(scene, size=16, samples=(1, 4), rounds=9, reference=(12, 256))
    error = {c.name: c.error for c in panel.contestants}
    assert panel.contestants[0].name == "plan, 1 spp" and set(error) >= {
        "plan, 4 spp",
        "everything on, 4 spp",
    }
    assert error["plan, 1 spp"][0] / error["plan, 4 spp"][0] == pytest.approx(2, rel=0.2)
    for name, (value, low, high) in error.items():
        assert 0 < low <= value <= high, name
    for c in panel.contestants:
        assert abs(c.more["bias"]) < 5 * c.more["bias_error"] + 0.01, c.name
        assert len(c.seconds) == len(panel.again) == 9
    same_noise = panel.at_equal_error(0)
    assert (same_noise.low, same_noise.ratio, same_noise.high) == (1, 1, 1)


def test_refinement_takes_the_error_of_float32_away_and_the_worlds_offset_does_not_matter_then():
    panel = geometry.depth(load_scene("far"), size=64, rays=60, rounds=3)
    refined, recentred, raw = panel.contestants
    assert refined.error[0] < 1e-13 and refined.more["wrong"] == 0
    # float32 has 6e-8; at coordinates of 2e6 its steps are 0.125 m.
    assert 1e-9 < recentred.error[0] < 1e-5 and recentred.more["wrong"] == 0
    assert raw.more["wrong"] > 0.5


def test_rays_answer_for_every_point_and_a_coarse_depth_map_is_wrong_or_silent():
    panel = point_visibility.visibility(load_scene("far"), size=64, points=150, rounds=3, maps=(8,))
    rays, nearest, bilinear = panel.contestants
    # Clopper & Pearson: none of 150 excludes a share above 1 - 0.025^(1 / 150).
    assert (
        rays.error == pytest.approx((0, 0, 1 - 0.025 ** (1 / 150))) and rays.more["unanswered"] == 0
    )
    assert nearest.error[0] == nearest.more["wrong"] > 0.02 and nearest.more["unanswered"] == 0
    assert bilinear.more["unanswered"] > 0.2
    assert bilinear.error[0] == pytest.approx(bilinear.more["wrong"] + bilinear.more["unanswered"])


def test_where_source_and_target_share_no_surface_the_panel_is_left_out_by_name(tmp_path):
    box = {"type": "box", "center": [0, 0, 0.5], "size": [0.6, 0.6, 0.6]}
    views = {"source": {"yaw": 0, "height": 0.5}, "targets": [{"yaw": 180, "height": 0.5}]}
    scene = make([{"name": "box", "shape": box, "texture": PLAIN}], [SKY], cameras=views)
    panel = point_visibility.visibility(scene, size=32, points=10, rounds=3, maps=(8,))
    write([panel, depth_panel("one")], tmp_path)
    assert "Left out: visibility of test. No point" in (tmp_path / "accuracy.md").read_text()
    shown = json.loads((tmp_path / "accuracy.json").read_text())["panels"]
    assert [panel["scene"] for panel in shown] == ["one"] and not (
        tmp_path / "visibility.svg"
    ).exists()


def test_a_depth_map_of_a_slanted_plane_answers_right_in_both_ways():
    camera = load_scene("spheres").with_size(64, 64).source
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.K).T
    depth = 4 / (1 + 0.2 * rays[..., 0])  # the plane z + 0.2 x = 4
    local = rays[20:40, 20:40].reshape(-1, 3) * depth[20:40, 20:40].reshape(-1, 1)
    for bilinear in (False, True):
        for stretch, expected in ((1.0, 1.0), (0.97, 1.0), (1.05, 0.0)):
            points = (stretch * local) @ camera.rotation + camera.position
            answer = point_visibility._seen_in_map(depth, camera, points, bilinear)
            assert (answer == expected).all()


def depth_panel(scene):
    slow = Contestant(
        "slow", (0.5, 0.4, 0.6), (2.0, 2.2, 2.4), {"median": 0.1, "p99": 0.2, "wrong": 0.0}
    )
    fast = Contestant(
        "fast", (0.0, 0.0, 0.0), (1.0, 1.1, 1.2), {"median": 0.0, "p99": 0.0, "wrong": 0.25}
    )
    return Panel("depth", scene, "largest relative error of depth", (slow, fast), (2.0, 2.2, 2.4))


def test_the_bias_of_a_picture_has_students_interval(tmp_path):
    seconds = (1.0, 1.1, 1.2, 1.1, 1.0, 1.1, 1.2)
    more = {"bias": 0.001, "bias_error": 0.001}
    one = Contestant("plan, 4 spp", (0.5, 0.4, 0.6), seconds, more)
    write([Panel("pictures", "one", "RMS", (one,), seconds, (seconds,))], tmp_path)
    # Of 7 rounds: t(0.975) with 6 degrees of freedom is 2.447 in any table.
    assert "+0.10 % ± 0.24" in (tmp_path / "accuracy.md").read_text()


def test_tables_show_the_known_ratio_of_each_scene(tmp_path):
    written = write([depth_panel("one"), depth_panel("two")], tmp_path)
    assert tmp_path / "accuracy.html" in written and (tmp_path / "depth.svg").is_file()
    text = (tmp_path / "accuracy.md").read_text()
    assert "**one**" in text and "**two**" in text and "| 0.500 |" in text and "25.00 %" in text
    assert "| again |" in text and "Left out" not in text


def test_an_unknown_scene_is_one_line(tmp_path):
    result = CliRunner().invoke(app, ["scenes", "accuracy", "nowhere", "--out", str(tmp_path)])
    assert result.exit_code == 2 and "nowhere" in result.output


@pytest.mark.slow
def test_panels_that_are_finished_are_read_and_not_measured_again(tmp_path, monkeypatch):
    asked = []

    def short(name, failing=False):
        real = getattr(accuracy, name)

        def question(scene, *, rounds, report):
            asked.append(name)
            if failing and asked.count(name) == 1:
                raise KeyboardInterrupt
            size = {"depth": {"rays": 20}, "visibility": {"points": 20, "maps": (8,)}}[name]
            return real(scene, size=16, rounds=rounds, report=report, **size)

        question.__name__ = name
        monkeypatch.setattr(accuracy, name, question)

    short("depth")
    short("visibility", failing=True)
    monkeypatch.setattr(accuracy, "PICTURE_SCENES", ())
    monkeypatch.setattr(accuracy, "GEOMETRY_SCENES", ("far",))
    call = ["scenes", "accuracy", "--rounds", "3", "--out", str(tmp_path)]
    killed = CliRunner().invoke(app, call)
    assert killed.exit_code == 130 and "finished panels are kept" in killed.stderr
    (record,) = (json.loads(path.read_text()) for path in (tmp_path / "cells").rglob("*.json"))
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0 and asked == ["depth", "visibility", "visibility"]
    # Seconds are among a panel's figures: measured again they would differ.
    panels = json.loads((tmp_path / "accuracy.json").read_text())["panels"]
    assert panels[0] == record["panel"] and [p["question"] for p in panels] == ["depth", asked[1]]
    written = {path: path.read_bytes() for path in tmp_path.glob("accuracy.*")}
    assert CliRunner().invoke(app, call).exit_code == 0 and len(asked) == 3
    assert {path: path.read_bytes() for path in written} == written and len(written) == 3
    # An undefined error is read back as such.
    record["panel"]["contestants"][0]["error"] = [None, None, None]
    assert np.isnan(Panel.from_record(record).contestants[0].error).all()
