"""Figures at tracks, against a loop over points of a plane and a step, and against COLMAP's tracks
of a corner of three walls.
"""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import textured_corner
import torch
from typer.testing import CliRunner

from attnwarp import Camera, Gaussians
from attnwarp.io import Dataset, write_ply, write_transforms
from attnwarp_eval.cli.main import app
from attnwarp_eval.tracks.find import Tracks, world_points, write
from attnwarp_eval.tracks.measure import OFF, measure, summarise


def disc(center, quat, size, count=1):
    return Gaussians(
        "2d",
        torch.tensor(np.reshape(center, (count, 3)), dtype=torch.float32),
        torch.tensor(np.broadcast_to(quat, (count, 4)).copy(), dtype=torch.float32),
        torch.full((count, 2), float(size)),
        torch.full((count,), 0.999),
        torch.zeros(count, 1, 3),
    )


VIEW = {"width": 64, "height": 48, "fov_y": 50, "up": (0, 1, 0)}
CAMERAS = [Camera.look_at((x, 0, 4), (0, 0, 0), **VIEW) for x in (-0.6, 0.0, 0.6)]
FLAT = (1.0, 0, 0, 0)


def pixel(camera, point):
    """Pinhole projection, by hand."""
    x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    K = camera.K
    return np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])


def depth_at(camera, x, y):
    """Depth of the plane z = 0 behind a pixel, by hand."""
    K, R = camera.K, camera.world_to_camera[:3, :3]
    ray = R.T @ np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
    return -camera.position[2] / ray[2]


def tracks_of(points, planted=()):
    """Tracks of points in all cameras; in the first, some are moved by a px vector."""
    image, point, xy = [], [], []
    for k, camera in enumerate(CAMERAS):
        for p, place in enumerate(points):
            image.append(k)
            point.append(p)
            moved = dict(planted).get(p, (0, 0)) if k == 0 else (0, 0)
            xy.append(pixel(camera, place) + moved)
    flags = np.zeros(len(points), dtype=bool)
    return Tracks(np.array(image), np.array(point), np.array(xy), flags)


def test_points_moved_by_known_px_are_found_and_all_others_are_right():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (40, 2)), np.zeros(40)])
    planted = {3: (3.0, 4.0), 17: (0.0, -2.5), 30: (1.0, 0.0)}
    pairs = measure(
        disc((0, 0, 0), FLAT, 30), CAMERAS, tracks_of(points, planted), "corrected", apart=(1, 2)
    )
    wanted = np.zeros(40)
    wanted[[3, 17, 30]] = 5.0, 2.5, 1.0
    assert [(p.source, p.target, p.apart) for p in pairs] == [(0, 1, 1), (1, 2, 1), (0, 2, 2)]
    for pair in pairs:
        # Depth is float32, and read between pixels: a plane's 1 / z is linear.
        expected = wanted if pair.source == 0 else np.zeros(40)
        np.testing.assert_allclose(pair.error, expected, atol=2e-3)
        assert pair.kept.all()
        source, target = CAMERAS[pair.source], CAMERAS[pair.target]
        # The lower of the two in the middle, as torch has it.
        depths = sorted(depth_at(target, x + 0.5, y + 0.5) for y in range(48) for x in range(64))
        middle = depths[(len(depths) - 1) // 2]
        for k, point in enumerate(points):
            place = target.unproject(pixel(target, point), middle)
            moved = dict(planted).get(k, (0, 0)) if pair.source == 0 else (0, 0)
            distance = np.linalg.norm(pixel(source, place) - pixel(source, point) - moved)
            assert pair.flat[k] == pytest.approx(distance, abs=2e-3)


def test_a_point_behind_a_step_is_dropped_and_its_position_is_that_of_the_step():
    step = disc([(0, 0, 0), (0.165, 0, 1.0)], FLAT, 30, 2)
    step.scales[1] = 0.08
    # Seen by the target right of the step's edge, hidden from the source by it.
    hidden, free = np.array([0.42, 0.0, 0.0]), np.array([-0.5, 0.3, 0.0])
    target, source = CAMERAS[2], CAMERAS[0]
    towards = (hidden - source.position) / (hidden - source.position)[2]
    at_step = source.position + towards * (1.0 - source.position[2])
    points = np.array([hidden, *(free + np.array([0, d, 0]) for d in np.linspace(0, 0.2, 6))])
    blocked = np.linalg.norm(at_step[:2] - [0.165, 0]) < 0.01
    (pair,) = [
        p for p in measure(step, CAMERAS, tracks_of(points), "corrected", apart=(2,))
        if (p.source, p.target) == (0, 2)
    ]  # fmt: skip
    through = (hidden - target.position) / (hidden - target.position)[2]
    clear = np.linalg.norm(
        (target.position + through * (1.0 - target.position[2]))[:2] - [0.165, 0]
    )
    assert blocked and clear > 0.29  # the step hides it from the source alone
    assert pair.kept.tolist() == [False] + [True] * 6
    np.testing.assert_allclose(pair.error, 0, atol=5e-3)


def test_splats_in_the_wrong_depth_have_the_error_of_their_parallax():
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (20, 2)), np.zeros(20)])
    near = disc((0, 0, 1.0), FLAT, 30)
    pair, _ = measure(near, CAMERAS, tracks_of(points), "corrected", apart=(1,))
    # Cameras 0.6 apart look at a wall 4 away: splats 3 away move every point by the parallax.
    target, source = CAMERAS[1], CAMERAS[0]
    for point, error in zip(points, pair.error, strict=True):
        towards = point - target.position
        at = target.position + towards * (1.0 - target.position[2]) / towards[2]
        distance = np.linalg.norm(pixel(source, at) - pixel(source, point))
        assert distance > 1
        # The ray through a float pixel, and depth in float32.
        assert error == pytest.approx(distance, abs=2e-3)


def test_figures_are_those_of_a_loop_over_the_points():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (30, 2)), np.zeros(30)])
    planted = {k: (rng.normal(0, 2), rng.normal(0, 2)) for k in range(30)}
    pairs = [
        replace(pair, kept=rng.random(30) < 0.7)
        for pair in measure(
            disc((0, 0, 0), FLAT, 30), CAMERAS, tracks_of(points, planted), "corrected"
        )
    ]
    found = summarise(pairs)
    errors = sorted(float(e) for pair in pairs for e in pair.error)
    middle = (errors[len(errors) // 2] + errors[(len(errors) - 1) // 2]) / 2
    assert found["median"].value == pytest.approx(middle, abs=1e-12)
    off = sum(error > OFF for error in errors)
    assert 0 < off < len(errors)
    assert found["off"].value == pytest.approx(off / len(errors))
    kept = off_and_dropped = 0
    for pair in pairs:
        for error, keeps in zip(pair.error, pair.kept, strict=True):
            kept += keeps
            off_and_dropped += error > OFF and not keeps
    assert found["kept"].value == pytest.approx(kept / len(errors))
    assert 0 < off_and_dropped < off
    assert found["dropped_off"].value == pytest.approx(off_and_dropped / off)
    for figure in found.values():
        assert figure.low <= figure.value <= figure.high


def test_points_that_a_fit_begins_with_are_not_judged(tmp_path):
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (20, 2)), np.zeros(20)])
    tracks = tracks_of(points)
    np.testing.assert_allclose(world_points(tracks, CAMERAS), points, atol=1e-9)
    paths = [tmp_path / f"{k}.png" for k in range(3)]
    for path in paths:
        cv2.imwrite(str(path), np.full((48, 64, 3), 90, np.uint8))
    half = tmp_path / "half"
    half.mkdir()
    write_transforms(half, Dataset(CAMERAS, paths))
    write(replace(tracks, started=np.arange(20) % 2 == 0), half / "tracks.npz")
    splats = tmp_path / "splats.ply"
    write_ply(splats, disc((0, 0, 0), FLAT, 30))
    done = CliRunner().invoke(
        app,
        ["tracks", str(half), "--ply", str(splats), "--out", str(tmp_path / "out")],
    )
    assert done.exit_code == 0, done.output
    rows = json.loads((tmp_path / "out/tracks.json").read_text())["rows"]
    assert {row["points"] // row["pairs"] for row in rows} == {10}
    assert (tmp_path / "out/tracks.html").is_file()


def test_bad_input_is_one_line(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((48, 64, 3), np.uint8))
    data = Dataset(CAMERAS[:1], [tmp_path / "0.png"])
    write_transforms(tmp_path, data)
    (tmp_path / "tracks.npz").write_bytes(b"cut")
    for options, word in (
        ([], "--ply"),
        (["--ply", "x.ply", "--preset", "none"], "--preset"),
        (["--ply", "x.ply"], "tracks.npz"),
    ):
        done = CliRunner().invoke(app, ["tracks", str(tmp_path), *options])
        assert done.exit_code == 2 and word in done.output, done.output
        assert "Traceback" not in done.output


def test_tracks_of_colmap_judge_the_walls_that_they_lie_on(tmp_path):
    pytest.importorskip("pycolmap")
    cameras = textured_corner.cameras()
    paths = [tmp_path / f"{k}.png" for k in range(6)]
    for path, camera in zip(paths, cameras, strict=True):
        cv2.imwrite(str(path), np.rint(255 * textured_corner.picture(0, camera)))
    write_transforms(tmp_path, Dataset(cameras, paths))
    steps = np.arange(0.02, 3, 0.06)
    across = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    half = np.sqrt(0.5)
    turns = ((half, 0, half, 0), (half, half, 0, 0), FLAT)

    def walls(offset):
        centers = [np.insert(across, axis, offset, axis=1) for axis in range(3)]
        quats = np.repeat(np.array(turns), len(across), axis=0)
        return disc(np.concatenate(centers), quats, 0.05, 3 * len(across))

    for name, offset in (("right", 0.0), ("moved", 0.1)):
        (tmp_path / name).mkdir()
        write_ply(tmp_path / name / "splats.ply", walls(offset))
    options = [part for name in ("right", "moved") for part in
               ("--ply", str(tmp_path / name / "splats.ply"))]  # fmt: skip
    done = CliRunner().invoke(
        app, ["tracks", str(tmp_path), *options, "--apart", "1", "--preset", "corrected",
              "--out", str(tmp_path / "out")],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    right, moved = json.loads((tmp_path / "out/tracks.json").read_text())["rows"]
    assert right["points"] > 300
    # SIFT's own noise is the floor; walls 0.1 off shift by parallax.
    assert right["figures"]["floor"]["value"] < 0.4
    assert right["figures"]["median"]["value"] < 0.6
    assert moved["figures"]["median"]["value"] > 3 * right["figures"]["median"]["value"]
