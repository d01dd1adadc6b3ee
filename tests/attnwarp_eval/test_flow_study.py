"""The study of flow against exact correspondences, at the size of a stamp."""

import json

import numpy as np
import pytest

from attnwarp_eval import flow_study
from attnwarp_eval.metric import metric
from attnwarp_eval.scene_file import load_scene


def test_a_turned_camera_keeps_the_point_it_looks_at_and_its_distance():
    scene = load_scene("bear").with_size(64, 64)
    same = flow_study.turned(scene, 0)
    np.testing.assert_allclose(same.world_to_camera, scene.source.world_to_camera, atol=1e-12)
    np.testing.assert_allclose(same.K, scene.source.K, atol=1e-12)
    quarter = flow_study.turned(scene, 90)
    middle = np.array(scene.spec.cameras.look_at)
    arms = [(camera.position - middle)[:2] for camera in (same, quarter)]
    assert arms[0] @ arms[1] == pytest.approx(0, abs=1e-12)
    assert np.linalg.norm(arms[0]) == pytest.approx(np.linalg.norm(arms[1]))
    np.testing.assert_allclose(quarter.project(middle)[0], [32, 32], atol=1e-9)


def test_the_study_tells_views_that_agree_from_views_that_do_not(tmp_path, capsys):
    arguments = ["--scenes", "bear", "--yaws", "5", "--size", "48", "--spp", "4", "--out", str(tmp_path)]
    flow_study.main(arguments)
    (row,) = json.loads((tmp_path / "flow.json").read_text())
    assert (row["scene"], row["yaw"], row["method"]) == ("bear", 5, "dis")
    exact = {kind: row["figures"][kind]["consistency.delta_e"] for kind in flow_study.PAIRS}
    # Red against violet is 28 to 30 at any size; the floor of 4 samples a pixel is 3 or so.
    assert exact["two_answers"] > 20 > 2 * exact["one_answer"] and exact["slip"] > exact["one_answer"]
    names = {name for kind in row["figures"].values() for name in kind} | set(row["flow"])
    assert all(metric(name).name == name for name in names)
    assert sorted(path.name for path in tmp_path.glob("*.png")) == sorted(
        f"bear-5-{kind}.png" for kind in flow_study.PAIRS
    )
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3 and printed[2].startswith("| bear | 5 | ")


def test_an_edit_with_one_result_is_refused():
    with pytest.raises(ValueError, match="edit 'polar' of 'bear': got one result, expected at least two answers"):
        next(flow_study.study("bear", "polar", size=16, spp=1, yaws=[5]))
