"""The numbers of pixels and cells against the library, closed forms, and the truth's own geometry."""

import math

import numpy as np
import pytest
import torch
from further import further

from attnwarp.render import render
from attnwarp.warp import depth_agrees, preset
from attnwarp_eval import metrics
from attnwarp_eval.inspect.cell import cell_of, cell_report
from attnwarp_eval.inspect.command import inspect_command
from attnwarp_eval.inspect.pair import ACCEPTED, Pair, blocks
from attnwarp_eval.inspect.pixel import report
from attnwarp_eval.study.shared import pictures
from attnwarp_eval.two_view import HIDDEN, VISIBLE

SIZE = 64


def pixels(seed, count=50, size=SIZE):
    return np.random.default_rng(seed).integers(0, size, (count, 2)).tolist()


@pytest.mark.parametrize("variant", further("corrected", "released", "paper"))
def test_a_rule_passes_exactly_where_its_margin_is_positive(chosen, variant):
    pair = chosen.pair(variant, "yaw060")
    seen = {True: 0, False: 0}
    for rule, mask in pair.view.rules.items():
        margin = pair.margins[rule][0]
        clear = np.isfinite(margin) & (abs(margin) > 1e-6)
        assert np.array_equal(mask.numpy()[clear], margin[clear] > 0), rule
        assert not mask.numpy()[np.isnan(margin)].any(), rule
        for verdict in seen:
            seen[verdict] += int((mask.numpy()[clear] == verdict).sum())
    assert min(seen.values()) > 200


@pytest.mark.parametrize("rule", ["camera_frame", "source_incidence"])
def test_the_angles_of_the_normal_tests_have_margins_too(chosen, rule):
    settings = preset("corrected", normal_test=rule, normal_angle=40.0)
    own = chosen.pair("corrected", "yaw060")
    pair = Pair(own.views, own.target, settings, own.model)
    margin, mask = pair.margins[rule][0], pair.view.rules[rule].numpy()
    clear = np.isfinite(margin) & (abs(margin) > 1e-3)
    assert np.array_equal(mask[clear], margin[clear] > 0)
    assert 0 < mask[clear].mean() < 1


def test_numbers_are_those_of_the_library_at_that_pixel(pair):
    truth, camera = pair.truth, pair.world.targets["yaw060"]
    center = render(pair.model, camera, depth="center")
    for column, row in pixels(2):
        result = report(pair, column, row)
        pixel = row, column
        assert np.array_equal(result.xy, pair.view.correspondence.xy[pixel], equal_nan=True)
        assert result.accepted == bool(pair.view.mask[pixel])
        assert [v.passed for v in result.verdicts] == [
            bool(m[pixel]) for m in pair.view.rules.values()
        ]
        expected = float(center.median_depth[pixel])
        np.testing.assert_equal(result.depths["center, median"], expected)
        if truth.hits.valid[pixel]:
            # The exact position again, by the camera's own projection of the point.
            xy, z = pair.world.source.project(result.point)
            assert result.exact.z == pytest.approx(float(z), abs=1e-12)
            if z > 0:
                assert result.exact.xy == pytest.approx(xy, abs=1e-9)
        # The point again, from the warp's own numbers.
        own = pair.view.correspondence
        if math.isfinite(result.z):
            world = own.source.position + own.source.rotation.T @ own.points[pixel].numpy()
            assert camera.project(world)[0] == pytest.approx([column + 0.5, row + 0.5], abs=1e-6)


def test_the_tolerance_is_the_one_that_decides(pair):
    """A source depth moved by a little less than the tolerance agrees, by a little more does not."""
    settings, own = pair.settings, pair.view.correspondence
    checked = 0
    for column, row in pixels(4, 400):
        pixel = row, column
        tolerance = pair.tolerance[pixel]
        if not (np.isfinite(pair.source_depth[pixel]) and pair.truth.visible[pixel]):
            continue
        for share, expected in ((0.99, True), (1.01, False)):
            # A plane at that depth has no slope of its own.
            flat = np.full(pair.size, float(own.z[pixel]) - share * tolerance)
            slope = (tolerance - settings.depth_relative * float(own.z[pixel])) / float(
                own.z[pixel]
            )
            agrees = depth_agrees(
                own, flat, relative=settings.depth_relative + slope, slope=0.0, spread=None
            )
            assert bool(agrees[pixel]) == expected
        checked += 1
        if checked == 5:
            break
    assert checked == 5


def test_what_hides_a_point_lies_before_it_on_its_way_to_the_source(pair):
    truth, eye = pair.truth, pair.world.source.position
    rows, columns = np.nonzero(truth.label == HIDDEN)
    blocked = 0
    for row, column in zip(rows[::40], columns[::40], strict=True):
        result = report(pair, column, row)
        if result.seen_instead is None:
            assert result.lines()[-1] == "turned away from the source"
            continue
        way, blocker = result.point - eye, result.seen_instead - eye
        share = np.linalg.norm(blocker) / np.linalg.norm(way)
        assert np.linalg.norm(np.cross(way, blocker)) < 1e-9 * (way @ way)
        assert share < 1
        assert result.lines()[-1] == f"hidden behind: {result.exact.blocked_by}"
        blocked += share < 0.99
    assert blocked > 3
    row, column = np.argwhere(truth.label == VISIBLE)[100]
    assert report(pair, column, row).seen_instead is None


def test_taps_and_weights_give_what_the_library_warps(pair):
    size = (16, 16)
    assert size in pair.layers
    warp = pair.layer(size)
    features = torch.rand(5, *size, dtype=torch.float64)
    warped = warp.warp(features)
    read = 0
    for column, row in pixels(5, 60, 16):
        cell = cell_report(pair, size, column, row)
        expected = warped[:, row, column].numpy()
        own = sum(tap.weight * features[:, tap.row, tap.column].numpy() for tap in cell.taps)
        assert own == pytest.approx(expected, abs=1e-12)
        assert cell.accepted == bool(warp.mask[row, column])
        position = warp.correspondence.xy[row, column].numpy()
        assert np.array_equal(cell.xy, position, equal_nan=True)
        # The mask's mean over the cell's 4 x 4 pixels, by counting.
        inside = pair.view.mask[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        assert cell.share == pytest.approx(inside.double().mean().item(), abs=1e-12)
        assert cell.accepted == (cell.share > 0.5 and bool(np.isfinite(cell.xy).all()))
        for tap in cell.taps:
            if np.isfinite(tap.point).all():
                # What the source sees at the tap projects to the tap's centre.
                xy, _ = pair.cameras[0].resize(16, 16).project(tap.point)
                assert xy == pytest.approx([tap.column + 0.5, tap.row + 0.5], abs=1e-9)
                read += 1
        truth = pair.truth_at(size)
        np.testing.assert_equal(cell.true_xy, truth.xy[row, column])
    assert read > 60
    assert cell_of(pair, size, 0, 63) == (0, 15)
    with pytest.raises(ValueError, match=r"cell: got \(16, 0\)"):
        cell_report(pair, size, 16, 0)


def test_the_mask_of_a_grid_is_shown_as_blocks(pair):
    mask = pair.layer((8, 8)).mask.numpy()
    assert np.array_equal(pair.mask((8, 8)), np.kron(mask, np.ones((8, 8), bool)))
    assert np.array_equal(blocks(np.arange(6).reshape(2, 3), (4, 6))[:2, :2], np.zeros((2, 2)))


def test_colours_of_the_mask_are_those_of_the_checks_own_counts(pair):
    """Pixels of each colour against the counts of the metric that judges masks."""
    truth, mask = pair.truth, pair.view.mask.numpy()
    counts = metrics.confusion(mask, truth.label, truth.hits.valid, truth.behind)
    image, target = pair.colors("mask"), pair.images[1]
    grey = 0.35 * target.mean(axis=2, keepdims=True)
    shown = {}
    for text, color in pair.legend("mask"):
        tint = (grey + 0.65 * pictures.rgb(color)).astype(np.float32)
        shown[text] = int((abs(image - tint).max(axis=2) < 1e-5).sum())
    assert shown["visible, accepted"] == counts["visible_accepted"] > 100
    assert shown["visible, rejected"] == counts["visible_rejected"]
    assert shown["hidden, accepted"] == counts["hidden_accepted"]
    rejected = counts["hidden_rejected"] + counts["outside_rejected"]
    assert shown["not visible, rejected"] == rejected > 100
    accepted = shown["outside the source image, accepted"]
    assert accepted + shown["behind the source camera, accepted"] == counts["outside_accepted"]
    ambiguous = counts["ambiguous_accepted"] + counts["ambiguous_rejected"]
    assert shown["ambiguous, not scored"] == ambiguous


def test_colours_of_the_rules_name_the_first_that_rejects(pair):
    image, target = pair.colors("rules"), pair.images[1]
    grey = 0.35 * target.mean(axis=2, keepdims=True)
    left = np.ones(pair.size, bool)
    legend = dict(pair.legend("rules"))
    for rule, mask in pair.view.rules.items():
        rejected = left & ~mask.numpy()
        tint = grey + 0.65 * pictures.rgb(legend[f"rejected by {rule}"])
        assert np.allclose(image[rejected], tint[rejected], atol=1e-5)
        left &= mask.numpy()
    assert np.allclose(image[left], (grey + 0.65 * pictures.rgb(ACCEPTED))[left], atol=1e-5)


def test_a_report_can_name_the_command_that_opens_a_view():
    command = inspect_command("my runs/a", "bear", "it's; rm -rf", "yaw060", pixel="3,4")
    assert command == (
        "attnwarp-eval inspect 'my runs/a' --scene bear --variant 'it'\"'\"'s; rm -rf' --view"
        " yaw060 --pixel 3,4"
    )
