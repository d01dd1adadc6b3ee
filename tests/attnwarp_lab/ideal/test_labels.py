"""Oracle: loops over pixels, written out from the definitions."""

import math

import numpy as np
import pytest
import torch

from attnwarp import Camera
from attnwarp.warp import preset
from attnwarp_eval.study.shared.controls import MovedView
from attnwarp_eval.study.shared.warps import warp_truth
from attnwarp_eval.world import world
from attnwarp_lab.ideal.labels import (
    NONE,
    carried_labels,
    depth_edges,
    edge_distance,
    label_transport,
)
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.thing import labels_of

PARTS = 9


@pytest.fixture(scope="module")
def labels():
    of = world("spheres", 64)
    cameras = [of.camera(name) for name in ("source", "yaw045")]
    return labels_of(
        of.scene, of.geometry, cameras, ["melon", "marble", "planet", "beach_ball"], PARTS
    )


def bounds_only(**changes):
    rules = {"in_front": False, "opaque": None, "depth_agreement": False, "normal_test": "none"}
    return preset("corrected", depth_relative=1e-4, depth_spread=0.02, **{**rules, **changes})


@pytest.mark.parametrize("grid", [8, 16, 32])
@pytest.mark.parametrize(
    "rules", [preset("corrected", depth_relative=1e-4, depth_spread=0.02), bounds_only()]
)
def test_labels_are_those_of_a_loop_over_pixels(labels, grid, rules):
    of = world("spheres", 64)
    pair = of.pair("yaw045", 64)
    layer = warp_truth(of, pair, rules).at((grid, grid))
    source, target = (token_parts(labels[name], (grid, grid)) for name in ("source", "yaw045"))
    carried = carried_labels(layer, source)
    figures = label_transport(carried, target, labels["yaw045"], pair.visible, pair.unseen)

    xy, mask, cell = layer.correspondence.xy.numpy(), layer.mask.numpy(), 64 // grid
    counts = dict.fromkeys(
        ("right", "wrong", "none", "hidden", "painted_hidden", "outside", "painted_outside"), 0
    )
    for row in range(grid):
        for column in range(grid):
            taken = NONE
            if mask[row, column]:
                u, v = np.clip(xy[row, column] - 0.5, 0, grid - 1)
                left, top = int(u), int(v)
                weights = {}
                for y, b in ((top, 1 - (v - top)), (min(top + 1, grid - 1), v - top)):
                    for x, a in ((left, 1 - (u - left)), (min(left + 1, grid - 1), u - left)):
                        weights[int(source[y, x])] = weights.get(
                            int(source[y, x]), 0.0
                        ) + np.float32(a * b)
                taken = max(sorted(weights), key=weights.__getitem__)
            assert taken == carried[row, column]
            seen = unseen = 0
            for y in range(row * cell, row * cell + cell):
                for x in range(column * cell, column * cell + cell):
                    own = labels["yaw045"][y, x] == target[row, column]
                    seen += own and pair.label[y, x] == 1
                    unseen += own and bool(pair.unseen[y, x])
            if target[row, column] < 0:
                counts["outside"] += 1
                counts["painted_outside"] += taken >= 0
            elif 2 * seen > cell * cell:
                counts[
                    "none"
                    if taken == NONE
                    else "right"
                    if taken == target[row, column]
                    else "wrong"
                ] += 1
            elif 2 * unseen > cell * cell:
                counts["hidden"] += 1
                counts["painted_hidden"] += taken >= 0
    visible = counts["right"] + counts["wrong"] + counts["none"]
    assert visible > 3
    assert figures["labels.visible"] == visible
    for name in ("right", "wrong", "none"):
        assert figures[f"labels.{name}"] == pytest.approx(counts[name] / visible)
    for name in ("hidden", "outside"):
        assert figures[f"labels.{name}"] == counts[name]
        if counts[name]:
            assert figures[f"labels.painted_{name}"] == pytest.approx(
                counts[f"painted_{name}"] / counts[name]
            )


@pytest.mark.parametrize(
    ("right", "wrong", "painted", "net"),
    [(24, 0, 0, 1.0), (0, 0, 0, 0.0), (0, 24, 0, -1.0), (20, 4, 8, 8 / 32), (18, 3, 0, 15 / 24)],
)
def test_net_labels_are_right_less_wrong_less_painted_by_hand(right, wrong, painted, net):
    true, seen = np.zeros((1, 40), np.int16), np.arange(40)[None] < 24
    carried = np.full((1, 40), NONE, np.int16)
    carried[0, :right], carried[0, right : right + wrong], carried[0, 24 : 24 + painted] = 0, 1, 0
    assert label_transport(carried, true, true, seen, ~seen)["labels.net"] == pytest.approx(net)
    few = np.arange(40)[None] < 19
    assert math.isnan(label_transport(carried, true, true, few, ~few)["labels.net"])


def test_net_labels_of_the_truth_come_before_no_mask_and_both_before_a_mirror(labels):
    of = world("spheres", 64)
    pair = of.pair("yaw045", 64)
    source, target = (token_parts(labels[name], (16, 16)) for name in ("source", "yaw045"))
    every = warp_truth(of, pair, bounds_only())
    exact = every.with_mask(torch.from_numpy(np.ascontiguousarray(pair.visible)))

    def net(view):
        carried = carried_labels(view.at((16, 16)), source)
        got = label_transport(carried, target, labels["yaw045"], pair.visible, pair.unseen)
        return got["labels.net"]

    assert net(exact) > net(every) > net(MovedView.of(every, "mirrored"))


def test_without_tokens_of_a_kind_a_share_is_undefined():
    outside = np.full((2, 2), -1, np.int16)
    nothing = np.zeros((4, 4), bool)
    figures = label_transport(outside, outside, np.full((4, 4), -1, np.int16), nothing, nothing)
    assert math.isnan(figures["labels.right"]) and math.isnan(figures["labels.painted_hidden"])
    assert figures["labels.painted_outside"] == 0.0 and figures["labels.outside"] == 4


def test_a_grid_that_does_not_divide_the_picture_is_refused():
    with pytest.raises(ValueError, match="tokens: got 3 x 3 for 4 x 4 px"):
        label_transport(
            np.zeros((3, 3), np.int16), np.zeros((3, 3), np.int16), np.zeros((4, 4), np.int16),
            np.zeros((4, 4), bool), np.zeros((4, 4), bool),
        )  # fmt: skip


def test_a_position_without_a_tap_takes_what_stands_outside():
    class Layer:
        mask = torch.ones(1, 1, dtype=torch.bool)

        def warp(self, features):
            return torch.zeros(len(features), 1, 1)

    assert carried_labels(Layer(), np.array([[0]], np.int16)).tolist() == [[-1]]


def test_distances_are_those_to_the_nearest_edge_pixel_of_any_token():
    depth = np.full((16, 16), 3.0)
    depth[5:9, 2:6] = 1.5  # a box before a wall
    step = np.zeros((16, 16), bool)  # pixels on either side of its outline
    step[4:10, 1:7] = True
    step[6:8, 3:5] = False
    step[[4, 4, 9, 9], [1, 6, 1, 6]] = False  # diagonal neighbours touch no step along an axis
    got = edge_distance(depth, (4, 4))
    rows, columns = np.nonzero(step)
    for row, column in np.ndindex(4, 4):
        y, x = np.mgrid[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        px = np.hypot(y[..., None] - rows, x[..., None] - columns).min()
        assert got[row, column] == pytest.approx(px / 4, abs=1e-6)
    assert np.isinf(edge_distance(np.full((8, 8), 2.0), (2, 2))).all()


def test_counts_by_distance_add_up_to_all(labels):
    of = world("spheres", 64)
    pair = of.pair("yaw045", 64)
    layer = warp_truth(of, pair, bounds_only()).at((16, 16))
    source, target = (token_parts(labels[name], (16, 16)) for name in ("source", "yaw045"))
    args = carried_labels(layer, source), target, labels["yaw045"], pair.visible, pair.unseen
    near = edge_distance(pair.hits.depth, (16, 16)) < 1
    whole, one, two = (label_transport(*args, among=of) for of in (None, near, ~near))
    for kind, total in (("right", "visible"), ("painted_hidden", "hidden")):
        shares = [np.nan_to_num(f[f"labels.{kind}"]) for f in (whole, one, two)]
        counts = [s * f[f"labels.{total}"] for s, f in zip(shares, (whole, one, two), strict=True)]
        assert counts[0] == pytest.approx(counts[1] + counts[2])
    assert one["labels.wrong"] > two["labels.wrong"]  # without a mask, edges go wrong


def test_a_depth_edge_is_a_share_of_the_nearest_depth():
    """Closed form: of three inverse depths 1, 1, 1 + x the bend is x and the nearest is 1 + x, so
    an edge of 5 % begins at x = 1 / 19 = 0.0526.
    """
    for x, edge in ((0.0520, False), (0.0533, True)):
        assert depth_edges(1 / np.array([[1.0, 1.0, 1.0, 1 + x, 1 + x, 1 + x]])).any() == edge


def test_depth_edges_are_both_sides_of_the_outline_of_a_box_before_a_wall():
    """Oracle: a loop over neighbours."""
    depth = np.full((20, 24), 4.0)
    depth[6:13, 9:17] = 3.0
    depth[:3] = np.nan  # the sky behind the wall's upper edge
    expected = np.zeros((20, 24), dtype=bool)
    filled = np.nan_to_num(depth, nan=9.0)
    for y in range(20):
        for x in range(24):
            for v, u in ((y, x + 1), (y, x - 1), (y + 1, x), (y - 1, x)):
                if 0 <= v < 20 and 0 <= u < 24 and filled[y, x] != filled[v, u]:
                    expected[y, x] = True
    np.testing.assert_array_equal(depth_edges(depth), expected)


def test_a_plane_at_a_grazing_angle_has_no_depth_edge_though_its_depth_leaps():
    grazing = Camera.look_at((0, -2.0, 0.1), (0, 0, 0), width=32, height=32, fov_y=40)
    rays = grazing.directions() @ grazing.rotation
    below = (-grazing.position[2] / rays[..., 2])[16:]  # the horizon lies above
    assert (below[0] / below[1] > 1.2).all()
    assert not depth_edges(below).any()
