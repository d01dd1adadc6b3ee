"""Meshes, the flight, and files to share, against closed forms, PyVista's reader and trimesh."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from attnwarp import Gaussians
from attnwarp_eval.colors import to_linear
from attnwarp_eval.inspect import scene
from attnwarp_eval.inspect.cell import cell_report
from attnwarp_eval.inspect.export import write_export
from attnwarp_eval.inspect.pixel import report
from attnwarp_eval.inspect.scene import State
from attnwarp_eval.study.schema import Splats

SIZE = 64
STATE = State("corrected", "yaw060")


@pytest.fixture(scope="module")
def few(chosen):
    splats = Splats(count=1000, position_noise=0.1, normal_noise=3.0)
    variants = {name: (variant, splats) for name, (variant, _) in chosen.variants.items()}
    return replace(chosen, variants=variants)


def test_frusta_end_at_the_corners_of_the_picture(pair):
    for camera in pair.cameras:
        _, corners = scene.frustum(camera, 0.7)
        xy, z = camera.project(corners)
        assert xy == pytest.approx(np.array([[0, 0], [SIZE, 0], [SIZE, SIZE], [0, SIZE]]), abs=1e-9)
        assert z == pytest.approx(0.7)


def test_cells_are_outlined_where_they_lie_in_the_picture(pair):
    camera = pair.cameras[1]
    outline = scene.cell_outlines(camera, (8, 8), [(2, 5), (3, 5)], 0.7)
    xy, _ = camera.project(np.asarray(outline.points, dtype=np.float64))
    assert xy[:4] == pytest.approx(8.0 * np.array([[2, 5], [3, 5], [3, 6], [2, 6]]), abs=1e-3)
    assert outline.n_lines == 8


def test_the_surface_carries_each_pixels_colour_at_its_true_point(pair):
    for coloring in pair.colorings:
        image = pair.colors(coloring)
        mesh = scene.seen_surface(pair.seen, image)
        index = mesh.point_data["pixel"]
        flat = np.rint(np.nan_to_num(image.reshape(-1, 3)[index]) * 255)
        assert np.array_equal(mesh.point_data["colors"], np.clip(flat, 0, 255).astype(np.uint8))
        assert np.array_equal(mesh.points, pair.truth.hits.point.reshape(-1, 3)[index])
    assert set(pair.colorings) == {
        "picture", "mask", "rules", "endpoint error", "depth error", "incidence",
    }  # fmt: skip
    with pytest.raises(ValueError, match="coloring: got 'green'"):
        pair.colors("green")


@pytest.mark.parametrize("count", [6, 25_000, 70_000])
def test_discs_have_the_splats_axes_and_sizes(count):
    rng = np.random.default_rng(0)
    splats = Gaussians(
        "3d", torch.tensor(rng.normal(size=(count, 3))), torch.tensor(rng.normal(size=(count, 4))),
        torch.tensor(rng.uniform(0.1, 1, size=(count, 3))), torch.ones(count).double(),
        torch.zeros(count, 1, 3).double(),
    )  # fmt: skip
    sides = scene.disc_sides(count)
    corners = scene.discs(splats).points.reshape(count, sides, 3)[:6].astype(float)
    spread = corners - corners.mean(1, keepdims=True)
    # The mean square of a regular polygon with radius s is s^2 / 2 along each axis.
    variance = np.linalg.eigvalsh(2 * np.swapaxes(spread, 1, 2) @ spread / sides)
    widest = np.sort(splats.scales[:6].numpy() ** 2, axis=1)[:, 1:]
    assert variance[:, 0] == pytest.approx(0, abs=1e-5)
    assert variance[:, 1:] == pytest.approx(widest, rel=1e-3)
    assert np.abs(np.einsum("nki,ni->nk", spread, splats.normals()[:6].numpy())).max() < 1e-5


def test_a_flight_goes_evenly_from_one_camera_to_the_other(pair, chosen):
    source, target = pair.cameras
    poses = scene.fly((source, target), chosen.center, 9)
    for (position, rotation), camera in ((poses[0], source), (poses[-1], target)):
        assert position == pytest.approx(camera.position, abs=1e-9)
        assert rotation == pytest.approx(camera.rotation, abs=1e-9)
    offsets = np.array([position for position, _ in poses]) - chosen.center
    radii = np.linalg.norm(offsets, axis=1)
    assert np.diff(radii) == pytest.approx((radii[-1] - radii[0]) / 8, abs=1e-9)
    units = offsets / radii[:, None]
    turns = np.arccos((units[:-1] * units[1:]).sum(axis=1))
    assert turns == pytest.approx(turns[0], abs=1e-6) and turns[0] > 0.05
    # A full turn around one place, and two cameras in one.
    assert len(scene.fly((source, source), chosen.center, 3)) == 3


def test_a_glb_file_is_read_by_trimesh_with_colours_in_place_and_upright(few, tmp_path):
    pair = few.pair("corrected", "yaw060")
    picked = report(pair, 30, 40)
    write_export(tmp_path / "a.glb", few, replace(STATE, splats=True, surface=True), picked)
    loaded = trimesh.load(tmp_path / "a.glb")
    names = {"seen", "discs", "whole surface", "source frustum", "target picture", "target ray"}
    nodes = {str(node).split("_")[0] for node in loaded.graph.nodes_geometry}
    assert names <= nodes
    data = (tmp_path / "a.glb").read_bytes()
    _, version, length = struct.unpack("<4sII", data[:12])
    assert (version, length) == (2, len(data))
    (size,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]

    def read(mesh, name):
        index = next(m for m in document["meshes"] if m["name"] == mesh)["primitives"][0]
        accessor = document["accessors"][index["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: np.float32, 5123: np.uint16}[accessor["componentType"]]
        values = np.frombuffer(
            binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]], kind
        )
        return values.reshape(accessor["count"], -1)

    expected = scene.seen_surface(pair.seen, pair.colors("mask"))
    colors = read("seen", "COLOR_0")[:, :3] / 65535
    assert colors == pytest.approx(to_linear(expected.point_data["colors"] / 255), abs=1e-4)
    points = read("seen", "POSITION") + few.center
    assert points == pytest.approx(np.asarray(expected.points), abs=1e-5)
    # The scene's up is z, glTF's is y.
    root = np.array(document["nodes"][-1]["matrix"]).reshape(4, 4).T
    assert root[:3, :3] @ few.up == pytest.approx([0, 1, 0])
    assert np.linalg.det(root[:3, :3]) == pytest.approx(1)
    # A picture is not upside down: glTF's (0, 0) is the picture's upper left corner.
    upper_left = read("source picture", "POSITION")[0] + few.center
    assert pair.cameras[0].project(upper_left)[0] == pytest.approx([0, 0], abs=1e-3)
    assert read("source picture", "TEXCOORD_0")[0].tolist() == [0, 0]


def test_a_cell_draws_its_taps_and_their_outlines(few):
    pair = few.pair("corrected", "yaw060")
    accepted = np.argwhere(pair.layer((16, 16)).mask.numpy())
    row, column = accepted[len(accepted) // 2]
    cell = cell_report(pair, (16, 16), int(column), int(row))
    parts = {
        part.name: part for part in scene.parts(few, pair, replace(STATE, layer=(16, 16)), cell)
    }
    taps = [tap for tap in cell.taps if tap.weight > 0 and np.isfinite(tap.point).all()]
    assert taps
    drawn = np.asarray(parts["taps"].mesh().points)
    assert drawn == pytest.approx(np.array([tap.point for tap in taps]), abs=1e-5)
    assert {"cell", "tap cells", "tap rays", "target ray"} <= set(parts)
