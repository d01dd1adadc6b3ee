"""The inspector against the library, closed forms, and VTK's own picking."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import pyvista
import torch
import vtk
from typer.testing import CliRunner

from attnwarp import Gaussians
from attnwarp.render import render
from attnwarp.warp import PRESETS
from attnwarp_eval.cli.main import app
from attnwarp_eval.inspect import scene as meshes
from attnwarp_eval.inspect import subject
from attnwarp_eval.inspect.pair import COLORINGS, Pair
from attnwarp_eval.inspect.pixel import report
from attnwarp_eval.inspect.window import MAIN, Window
from attnwarp_eval.study.parts import Splats
from attnwarp_eval.twoview import HIDDEN, VISIBLE

SIZE = 64


@pytest.fixture(scope="module")
def chosen():
    return subject.of_scene("spheres", SIZE)


@pytest.fixture(scope="module")
def pair(chosen) -> Pair:
    return chosen.pair("corrected", "yaw060")


@pytest.fixture(scope="module")
def window(chosen):
    # Without a graphics card, the 40,000 discs of a study take seconds a picture.
    splats = Splats(count=1000, position_noise=0.1, normal_noise=3.0)
    few = replace(
        chosen, variants={name: (variant, splats) for name, (variant, _) in chosen.variants.items()}
    )
    opened = Window(
        few.pair, list(few.variants), list(few.targets), target="yaw060",
        off_screen=True, size=(900, 600),
    )  # fmt: skip
    yield opened
    opened.plotter.close()


def pixels(seed: int, count: int = 50) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, SIZE, (count, 2))


@pytest.mark.parametrize("variant", ["corrected", "released"])
def test_a_rule_passes_exactly_where_its_margin_is_positive(chosen, variant):
    pair = chosen.pair(variant, "yaw060")
    seen = {True: 0, False: 0}
    for column, row in pixels(1, 150):
        for verdict in report(pair, column, row).verdicts:
            assert verdict.passed == bool(pair.view.rules[verdict.rule][row, column])
            if math.isfinite(verdict.margin) and abs(verdict.margin) > 1e-9:
                assert verdict.passed == (verdict.margin > 0), (verdict, column, row)
                seen[verdict.passed] += 1
    assert min(seen.values()) > 20


def test_numbers_are_those_of_the_library_at_that_pixel(pair):
    truth, camera = pair.truth, pair.world.targets["yaw060"]
    center = render(pair.model, camera, depth="center")
    for column, row in pixels(2):
        found = report(pair, column, row)
        hit = truth.hits.valid[row, column]
        assert np.array_equal(found.xy, pair.view.correspondence.xy[row, column], equal_nan=True)
        assert found.accepted == bool(pair.view.mask[row, column])
        expected = float(center.median_depth[row, column])
        np.testing.assert_equal(found.depths["center, median"], expected)
        if hit:
            # The exact position again, by the camera's own projection of the point.
            xy, z = pair.world.source.project(found.point)
            assert found.true_z == pytest.approx(float(z), abs=1e-12)
            if z > 0:
                assert found.true_xy == pytest.approx(xy, abs=1e-9)


def test_what_hides_a_point_lies_before_it_on_its_way_to_the_source(pair):
    truth, eye = pair.truth, pair.world.source.position
    rows, columns = np.nonzero(truth.label == HIDDEN)
    blocked = 0
    for row, column in zip(rows[::40], columns[::40], strict=True):
        found = report(pair, column, row)
        way, blocker = found.point - eye, found.blocker - eye
        share = np.linalg.norm(blocker) / np.linalg.norm(way)
        assert np.linalg.norm(np.cross(way, blocker)) < 1e-9 * (way @ way)
        assert share <= 1 + 1e-9
        if found.blocked_by:
            blocked += share < 0.99
    assert blocked > 3
    row, column = np.argwhere(truth.label == VISIBLE)[100]
    assert report(pair, column, row).blocked_by == ""


def test_frusta_end_at_the_corners_of_the_picture(pair):
    for camera in (pair.world.source, pair.world.targets["yaw060"]):
        _, corners = meshes.frustum(camera, 0.7)
        xy, z = camera.project(corners)
        assert xy == pytest.approx(np.array([[0, 0], [SIZE, 0], [SIZE, SIZE], [0, SIZE]]), abs=1e-9)
        assert z == pytest.approx(0.7)


def test_the_surface_carries_each_pixels_colour_at_its_true_point(pair):
    for coloring in COLORINGS:
        image = pair.colors(coloring)
        mesh = meshes.seen_surface(pair.truth.hits, image)
        index = mesh.point_data["pixel"]
        flat = np.rint(np.nan_to_num(image.reshape(-1, 3)[index]) * 255)
        assert np.array_equal(mesh.point_data["colors"], np.clip(flat, 0, 255).astype(np.uint8))
        assert np.array_equal(mesh.points, pair.truth.hits.point.reshape(-1, 3)[index])
    with pytest.raises(ValueError, match="coloring: got 'green'"):
        pair.colors("green")


def test_discs_have_the_splats_axes_and_sizes():
    rng = np.random.default_rng(0)
    quats = torch.tensor(rng.normal(size=(6, 4)))
    scales = torch.tensor(rng.uniform(0.1, 1, size=(6, 3)))
    splats = Gaussians(
        "3d", torch.tensor(rng.normal(size=(6, 3))), quats, scales, torch.ones(6).double(),
        torch.zeros(6, 1, 3).double(),
    )  # fmt: skip
    corners = meshes.discs(splats).points.reshape(6, meshes.DISC_SIDES, 3).astype(float)
    spread = corners - corners.mean(1, keepdims=True)
    # The mean square of a regular polygon with radius s is s^2 / 2 along each axis.
    variance = np.linalg.eigvalsh(2 * np.swapaxes(spread, 1, 2) @ spread / meshes.DISC_SIDES)
    widest = np.sort(scales.numpy() ** 2, axis=1)[:, 1:]
    assert variance[:, 0] == pytest.approx(0, abs=1e-5)
    assert variance[:, 1:] == pytest.approx(widest, rel=1e-3)
    normals = splats.normals().numpy()
    assert np.abs(np.einsum("nki,ni->nk", spread, normals)).max() < 1e-5


def test_picking_on_screen_finds_the_pixel_that_lies_there(window, pair):
    window.look_through("yaw060")
    renderer = window.plotter.renderers[MAIN]
    window.plotter.render()
    picker = vtk.vtkPointPicker()
    picker.SetTolerance(0.002)
    actor = renderer.actors["seen"]
    picker.PickFromListOn()
    picker.AddPickList(actor)
    points = pair.truth.hits.point
    tried = 0
    for column, row in pixels(3, 120):
        if not pair.truth.hits.valid[row, column]:
            continue
        renderer.SetWorldPoint(*points[row, column], 1)
        renderer.WorldToDisplay()
        x, y, _ = renderer.GetDisplayPoint()
        left, bottom, right, top = renderer.GetViewport()
        width, height = window.plotter.window_size
        if not (left * width < x < right * width and bottom * height < y < top * height):
            continue
        picker.Pick(x, y, 0, renderer)
        window.picked = None
        window._picked_point(None, picker)
        assert window.picked is not None
        assert abs(window.picked.column - column) <= 1 and abs(window.picked.row - row) <= 1
        tried += 1
    assert tried >= 50


def test_views_variants_and_colourings_change_what_is_on_show(window, tmp_path):
    def picture() -> np.ndarray:
        return window.plotter.screenshot(return_img=True)

    window.look_from_outside()
    window.show_coloring("mask")
    first = picture()
    window.show_coloring("picture")
    second = picture()
    assert (first != second).any()
    window.show_target("yaw120")
    assert window.pair.target == "yaw120" and (picture() != second).any()
    for key in ("d", "g", "question"):
        before = picture()
        window._actions()[key]()
        assert (picture() != before).any(), key
    window._actions()["n"]()
    assert (
        window.target == window.targets[(window.targets.index("yaw120") + 1) % len(window.targets)]
    )
    window.show_target("yaw060")


def test_files_to_share_hold_the_surface(window, pair, tmp_path):
    window.export(tmp_path / "a.vtp")
    points = pyvista.read(tmp_path / "a.vtp").n_points
    assert points == int(window.pair.truth.hits.valid.sum())
    window.export(tmp_path / "a.gltf")
    assert (tmp_path / "a.gltf").stat().st_size > 10_000


def test_the_command_draws_and_explains_and_refuses_by_name(tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    def invoke(*arguments):
        return CliRunner().invoke(app, ["inspect", *map(str, arguments)])

    out = tmp_path / "a.png"
    done = invoke("spheres", "--size", SIZE, "--view", "yaw060", "--pixel", "30,40",
                  "--screenshot", out)  # fmt: skip
    assert done.exit_code == 0 and "depth, truth:" in done.stdout
    assert pyvista.read(out).dimensions[0] > 1000
    small = ("spheres", "--size", SIZE)
    for arguments, message in (
        ((*small, "--view", "yaw06"), "view: got 'yaw06'; did you mean 'yaw060'?"),
        ((*small, "--variant", "papper"), "variant: got 'papper'; did you mean 'paper'?"),
        ((*small, "--color", "maks"), "--color: got 'maks'; did you mean 'mask'?"),
        ((*small, "--pixel", "30"), "--pixel: got '30', expected COLUMN,ROW"),
        ((*small, "--pixel", "64,3"), "--pixel: pixel: got (64, 3)"),
        ((*small, "--scene", "bear"), "so --scene has no meaning"),
        (("sphere",), "spheres"),
        (small, "no display; draw a picture instead with --screenshot FILE"),
        ((*small, "--export", tmp_path / "a.stl"), "got .stl, expected .html, .gltf or .vtp"),
    ):
        failed = invoke(*arguments)
        assert failed.exit_code == 2 and message in failed.stderr, (arguments, failed.stderr)


def test_presets_of_a_scene_are_those_of_the_library(chosen):
    assert set(chosen.variants) == set(PRESETS)
    for name, (variant, _) in chosen.variants.items():
        assert variant.settings() == PRESETS[name]
