"""The instrument judged by itself: exact depth through the warp, and the exact mask against
itself."""

import math

import mitsuba
import numpy as np
import pytest
import torch
import written_runs

from attnwarp.warp.depth import TAP_SPREAD
from attnwarp.warp.rules import EXACT_DEPTH_TOLERANCE
from attnwarp.warp.settings import PRESETS, preset
from attnwarp.warp.view import Surface, warp_surfaces
from attnwarp_eval import metrics
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.probes.calibration.measure import Extra, transport_of
from attnwarp_eval.study.run import plan as plan_run
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.study import parse_study
from attnwarp_eval.study.work import compute
from attnwarp_eval.truth import Geometry, two_view
from attnwarp_eval.truth.features import SolidField

SIZE = 128
EXACT = preset("corrected", depth_relative=EXACT_DEPTH_TOLERANCE, depth_spread=TAP_SPREAD)


@pytest.fixture(scope="module")
def pairs():
    """(yaw, what is exactly known, the source's exact surface) of some views of the spheres
    scene."""
    scene = load_scene("spheres").with_size(SIZE, SIZE)
    geometry = Geometry(scene)
    seen = geometry.trace(scene.source)
    targets = {camera.name: camera for camera in scene.targets}
    result = {
        yaw: two_view(geometry, scene.source, targets[f"yaw{yaw:03d}"]) for yaw in (10, 45, 90, 150)
    }
    return scene, geometry, Surface(seen.depth, seen.normal), result


def warped(pair, source_surface, settings):
    return warp_surfaces(
        pair.source,
        pair.target,
        Surface(pair.hits.depth, pair.hits.normal),
        source_surface,
        settings,
    )


def test_the_truths_own_depth_has_no_endpoint_error(pairs):
    _, _, seen, result = pairs
    for pair in result.values():
        got = metrics.endpoint_error(
            warped(pair, seen, EXACT).correspondence.xy, pair.xy, pair.visible
        )
        assert got["warp.epe_p95"] < 1e-9
        assert got["warp.coverage"] == 1


def test_the_exact_mask_against_itself_is_perfect(pairs):
    for pair in pairs[3].values():
        got = metrics.mask_error(pair.visible, pair.label, pair.hits.valid, pair.behind, pair.edge)
        assert got["occlusion.f1"] == got["occlusion.f1.interior"] == got["occlusion.f1.edge"] == 1


def test_with_exact_depth_the_corrected_rules_accept_nothing_wrong(pairs):
    # Judged by ray casting, which shares no step with depth agreement. Ground whose depth changes
    # by more than 2 % a pixel at this size is rejected, 4 % of what is visible.
    _, _, seen, result = pairs
    total = dict.fromkeys(metrics.COUNTS, 0)
    inner = dict(total)
    for pair in result.values():
        mask = warped(pair, seen, EXACT).mask
        for sums, among in ((total, None), (inner, ~pair.edge)):
            for name, count in metrics.confusion(
                mask, pair.label, pair.hits.valid, pair.behind, among
            ).items():
                sums[name] += count
    assert total["visible_accepted"] > 10_000
    assert total["hidden_rejected"] > 3_000
    assert total["hidden_accepted"] == total["outside_accepted"] == total["empty_accepted"] == 0
    assert metrics.scores(inner)["occlusion.recall"] > 0.93


def test_bounds_alone_accept_hidden_surface_and_points_behind_the_camera(pairs):
    _, _, seen, result = pairs
    bare = preset("paper", gaussian_filter="none")
    rows = []
    for yaw, pair in result.items():
        mask = warped(pair, seen, bare).mask
        rows.append((yaw, metrics.confusion(mask, pair.label, pair.hits.valid, pair.behind)))
    bins = metrics.by_yaw(rows, edges=(0, 30, 120, 180))
    hidden = [b.scores["occlusion.hidden_share"] for b in bins]
    assert hidden[0] < hidden[1] < hidden[2]
    assert hidden[2] > 0.5
    assert bins[2].counts["behind_accepted"] > 0


@pytest.mark.parametrize("size", [128, 32])
def test_features_of_the_solid_field_warp_to_their_own_points(pairs, size):
    scene, geometry, seen, result = pairs
    field = SolidField(scene.center, 4.0, channels=4)
    pair = result[45]
    layer = warped(pair, seen, EXACT).at((size, size))
    small = two_view(geometry, pair.source.resize(size, size), pair.target.resize(size, size))
    features = torch.from_numpy(field.on_grid(geometry.trace(small.source).point))
    exact = field.on_grid(small.hits.point, background=math.nan)
    got = metrics.feature_error(layer.warp(features), exact, layer.mask, small.visible, small.edge)
    slipped = warped(
        pair, seen, preset("corrected", **{**EXACT.to_dict(), "pixel_centers": "integer"})
    ).at((size, size))
    worse = metrics.feature_error(
        slipped.warp(features), exact, slipped.mask, small.visible, small.edge
    )
    assert got["warp.feature_pixels"] > 0.1 * np.count_nonzero(small.hits.valid)
    # At 32 the field's shortest waves span 4 px or so on the nearest ground: interpolation itself
    # errs by some percent.
    assert got["warp.feature_accepted.interior"] < {128: 0.02, 32: 0.2}[size]
    assert worse["warp.feature_accepted.interior"] > 1.2 * got["warp.feature_accepted.interior"]


def indices_in_source(pair, slip):
    """(H, W, 2) what a warp without a test of the sign of z holds against the source's image: the
    position of each target pixel's point, less ``slip``; pixels are unprojected ``slip`` off."""
    source, target = pair.source, pair.target
    rows, columns = np.indices(pair.hits.depth.shape) + 0.5 - slip
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(target.K).T
    world = (rays * pair.hits.depth[..., None]) @ target.rotation + target.position
    homogeneous = (world - source.position) @ source.rotation.T @ source.K.T
    return homogeneous[..., :2] / homogeneous[..., 2:]


@pytest.mark.parametrize("yaw", [45, 150])
@pytest.mark.parametrize(("name", "slip"), [("paper", 0.0), ("released", 0.5)])
def test_with_exact_depth_paper_and_released_accept_what_projects_into_the_image(
    pairs, name, slip, yaw
):
    """Pictures without contrast pass the released preset's photometric test everywhere."""
    _, _, seen, result = pairs
    pair = result[yaw]
    image = np.full((SIZE, SIZE, 3), 0.5)
    view = warp_surfaces(
        pair.source,
        pair.target,
        Surface(pair.hits.depth, pair.hits.normal, image=image),
        Surface(seen.depth, seen.normal, image=image),
        PRESETS[name],
    )
    index = indices_in_source(pair, slip)
    with np.errstate(invalid="ignore"):
        inside = ((index >= 0) & (index <= SIZE)).all(-1)
        # What lies on the border within rounding may fall on either side.
        clear = (np.abs(index) > 1e-6).all(-1) & (np.abs(index - SIZE) > 1e-6).all(-1)
    if slip:
        # Sampled with integer centres, the picture ends at the last pixel's centre.
        clear &= (index <= SIZE - 1).all(-1) | (index > SIZE).any(-1)
    assert 0.05 < inside.mean() < 0.95
    assert np.array_equal(view.mask.numpy()[clear], (inside & pair.hits.valid)[clear])


def test_the_report_says_which_effects_the_studys_scenes_call_for(tmp_path):
    def sections(**scenes):
        study = {"name": "s", "scenes": list(scenes), "probes": {"calibration": []}}
        cells = [
            written_runs.outcome(
                "calibration", name, ["calibration"], written_runs.record([], **extra)
            )
            for name, extra in scenes.items()
        ]
        made = report_of("calibration").sections(
            written_runs.results(study, cells), Layout(tmp_path)
        )
        return [section for section in made if section.title != "Calibration"]

    (section,) = sections(fog=Extra(transport_of(load_scene("fog"))).to_json())
    ((scene, needed, missing, planned, full),) = section.tables[0].rows
    assert scene == "fog" and "shadows" in needed and "medium" in needed and missing == "–"
    assert planned == full == "volpath"
    assert "Mitsuba's `scalar_rgb`" in section.text[-1]
    (section,) = sections(lens=Extra(transport_of(load_scene("lens"))).to_json())
    assert section.tables[0].rows[0][3] == "path, thin lens"


def test_a_record_names_the_variant_that_drew_its_pictures(tmp_path):
    """Oracle: the variant that Mitsuba says it is at."""
    study = {"name": "s", "scenes": ["spheres"], "size": 16, "spp": 1, "variants": {"a": {}}}
    run = plan_run(parse_study({**study, "probes": {"depth": ["a"]}}), Store(tmp_path))
    (cell,) = (cell for cell in run.cells if cell.probe == "calibration")
    stored = compute(probe("calibration"), cell, tmp_path).to_json()
    assert stored["effects"]["variant"] == mitsuba.variant()
    again = probe("calibration").read(stored)
    assert again.to_json() == stored
