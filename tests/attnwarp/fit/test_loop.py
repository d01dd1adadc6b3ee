"""The fit as a whole: it gets better, it can be stopped and gone on with, and it says what is
wrong.
"""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from edit_folders import Watched
from rounding import prepared

from attnwarp import Camera, Gaussians
from attnwarp.errors import InputError
from attnwarp.fit import FitSettings, Views, fit, from_points, loop
from attnwarp.fit.loop import CHECKPOINT, SPLATS
from attnwarp.fit.model import Model
from attnwarp.io import read_ply
from attnwarp.render import reference, render
from attnwarp.trial import disc, view
from attnwarp.workdir import Workdir

from .conftest import blobs, pictures, ring

BUSY = {
    "iterations": 60,
    "densify_from": 1 / 6,
    "densify_every": 1 / 6,
    "densify_least": 10,
    "densify_until": 0.9,
    "reset_every": 0.5,
    "reset_least": 1,
    "sh_degree": 1,
    "sh_every": 1 / 3,
    "normal_from": 0.2,
    "evaluate_every": 20,
    "grow_gradient": 1e-5,
    "max_splats": 90,
    "background": "random",
    "prune_opacity": 0.005,
}
"""Everything that a fit does happens within 60 iterations."""

FAST = {
    "sh_degree": 0,
    "densify": False,
    "lr_means": 1e-3,
    "lr_dc": 2e-2,
    "lr_opacity": 0.2,
    "lr_scales": 2e-2,
}
"""40 splats can be pushed harder than thousands."""


def with_four_held_out(scene):
    """The scene with as many held-out views as choosing needs."""
    (a, b), cameras, images = scene[1].images, scene[0].cameras, scene[0].images
    held_out = Views([*scene[1].cameras, *cameras[:2]], [a, b, *images[:2]])
    return Views(cameras[2:], images[2:]), held_out, *scene[2:]


def begin(scene, **changes):
    settings = FitSettings(**changes)
    return (
        from_points(scene[2], scene[3], kind=settings.kind, sh_degree=settings.sh_degree),
        settings,
    )


def sitting(scene, start, settings, folder, until=None, **more):
    """A fit in a folder, asked to stop after so many iterations of this sitting."""
    steps = itertools.count()
    stop = None if until is None else lambda: next(steps) >= until
    return fit(start, scene[0], settings, held_out=scene[1], folder=folder, stop=stop, **more)


def values(splats: Gaussians):
    return {name: getattr(splats, name) for name in ("means", "quats", "scales", "opacities", "sh")}


def same_bits(a: Gaussians, b: Gaussians) -> bool:
    return all(
        torch.equal(x, y) for x, y in zip(values(a).values(), values(b).values(), strict=True)
    )


def untimed(history):
    return [dataclasses.replace(record, seconds=0.0, cpu_seconds=0.0) for record in history]


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_a_fit_brings_held_out_views_closer_to_their_pictures(scene, kind):
    start, settings = begin(scene, kind=kind, iterations=200, **FAST)
    result = fit(start, scene[0], settings, held_out=scene[1])
    first, last = result.history[0], result.history[-1]
    assert result.stopped == "iterations"
    assert (first.iteration, last.iteration) == (0, 200)
    # What 200 steps add is far above what a seed would change.
    assert last.psnr > first.psnr + 5


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_the_gpu_backend_fits_as_well_as_the_cpus(kind):
    """Pictures of 64 px on Warp's CPU device. With splats that grow too; but which ones grow, a
    last bit may decide, so that fits by one backend differ by 0.5 dB."""
    truth = blobs(40)
    cameras = ring(9, size=64)
    views, held_out = pictures(truth, cameras[1:]), pictures(truth, cameras[:1])
    start = from_points(truth.world_means(), kind=kind, sh_degree=0)

    def reached(backend, **changes):
        settings = FitSettings(**{**FAST, **changes, "kind": kind, "iterations": 250})
        result = fit(start, views, settings, held_out=held_out, backend=backend)
        return result.history[-1].psnr, result.history[0].psnr, len(result.gaussians)

    psnr, before, _ = reached("gpu")
    assert psnr == pytest.approx(reached("cpu")[0], abs=0.3) and psnr > before + 3
    growing = {"densify": True, "densify_from": 0.2, "densify_every": 0.2, "grow_gradient": 1e-5}
    psnr, _, count = reached("gpu", **growing, max_splats=60)
    assert psnr == pytest.approx(reached("cpu", **growing, max_splats=60)[0], abs=1)
    assert len(start) == 40 < count <= 60  # what no view shows goes after the last refinement


@pytest.mark.slow
def test_a_fit_begun_by_one_backend_goes_on_by_another(scene, tmp_path):
    start, settings = begin(scene, iterations=40, **FAST)
    whole = fit(start, scene[0], settings, held_out=scene[1])
    sitting(scene, start, settings, tmp_path, until=20)
    result = sitting(scene, start, settings, tmp_path, backend="gpu")
    assert result.history[-1].psnr == pytest.approx(whole.history[-1].psnr, abs=0.05)


def test_a_fit_that_weighs_the_distortion_has_less_of_it(scene):
    """Oracle: the paper's sum over the fitted splats."""
    left = {}
    for weight in (0.0, 3.0):
        start, settings = begin(scene, iterations=150, distortion=weight, distortion_from=0, **FAST)
        splats = fit(start, scene[0], settings).gaussians
        sums = [reference.distortion_l1(prepared(splats, c)) for c in scene[0].cameras]
        left[weight] = sum(float(each.mean()) for each in sums)
    assert left[3.0] < 0.7 * left[0.0]


def test_the_harmonics_come_in_one_degree_after_another(scene, monkeypatch):
    asked = []

    def watched(*args, sh_degree, **options):
        asked.append(sh_degree)
        return render(*args, sh_degree=sh_degree, **options)

    monkeypatch.setattr("attnwarp.fit.loop.render", watched)
    k = 3
    start, settings = begin(
        scene, iterations=4 * k, sh_every=1 / 4, evaluate_every=1000, **{**FAST, "sh_degree": 2}
    )
    result = fit(start, scene[0], settings)
    # Iteration i is drawn with degree i // k, up to the settings' own: 0 at 0, 1 from k, 2 from 2k,
    # and 2 it stays.
    assert asked == [0, 0, 0, 1, 1, 1, 2, 2, 2, 2, 2, 2]
    # What was not drawn had no gradient and stays as it began; what was drawn moved.
    few = dataclasses.replace(settings, iterations=k, sh_every=1)
    only_first = fit(start, scene[0], few).gaussians.sh
    assert bool((only_first[:, 1:] == 0).all()) and not torch.equal(
        only_first[:, :1], start.sh[:, :1]
    )
    assert bool((result.gaussians.sh[:, 1:4] != 0).any()) and bool(
        (result.gaussians.sh[:, 4:] != 0).any()
    )
    # Splats that were fitted before use what they have from the first iteration on.
    for sh, degrees in (
        (result.gaussians.sh, [2] * 12),
        (torch.cat([result.gaussians.sh[:, :4], start.sh[:, 4:]], 1), [1, 1, 1, *[2] * 9]),
    ):
        asked.clear()
        fit(dataclasses.replace(result.gaussians, sh=sh), scene[0], settings)
        assert asked == degrees


@pytest.mark.parametrize("iterations", [400, 1000])
def test_a_short_fit_adds_splats_and_uses_all_harmonics(scene, iterations):
    cameras = ring(8, size=16)
    start, settings = begin(scene, iterations=iterations, sh_degree=2, ssim=0, distortion=0)
    result = fit(start, pictures(blobs(), cameras), settings)
    assert len(result.gaussians) > len(start)
    assert bool((result.gaussians.sh[:, 4:] != 0).any())


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_stopped_anywhere_and_gone_on_with_a_fit_gives_the_same_bits(scene, kind, tmp_path):
    start, settings = begin(scene, kind=kind, **BUSY)
    whole = fit(start, scene[0], settings, held_out=scene[1])
    assert len(whole.gaussians) > len(start)  # splats were added, or nothing much was tested
    for until in (7, 30, 41):
        sitting(scene, start, settings, tmp_path, until)
    parts = sitting(scene, start, settings, tmp_path)
    assert same_bits(whole.gaussians, parts.gaussians)
    # Sittings that ended between two evaluations evaluated once more; those in common are equal.
    common = {record.iteration for record in whole.history}
    assert untimed(r for r in parts.history if r.iteration in common) == untimed(whole.history)


def test_torchs_threads_change_no_bit_of_the_splats():
    """Pictures and harmonics are large enough to be shared out, from 32,768 numbers on."""
    points = np.random.default_rng(0).normal(size=(3000, 3)) / 3
    start = from_points(points, kind="2d", sh_degree=2)
    cameras = ring(3, size=112)
    views = pictures(blobs(), cameras)
    settings = FitSettings(iterations=3, sh_degree=2, sh_every=1 / 3, densify=False, normal_from=0)
    results, before = [], torch.get_num_threads()
    for count in (1, 3):
        torch.set_num_threads(count)
        results.append(fit(start, views, settings).gaussians)
    torch.set_num_threads(before)
    assert same_bits(*results)


def test_a_fit_that_is_stopped_leaves_its_splats_and_a_checkpoint(scene, tmp_path):
    start, settings = begin(scene, **BUSY)
    result = sitting(scene, start, settings, tmp_path, until=10, checkpoint_seconds=0)
    assert result.stopped == "asked" and result.iteration < settings.iterations
    final = read_ply(tmp_path / SPLATS)
    expected = result.gaussians.world_means().astype(np.float32)
    assert np.array_equal(final.world_means(), expected)
    assert sorted(p.name for p in tmp_path.iterdir()) == [CHECKPOINT, SPLATS]


def test_the_last_step_that_is_shown_has_the_results_own_evaluation(scene):
    start, settings = begin(scene, iterations=3, evaluate_every=1000, **FAST)
    shown = []
    report = Watched(step=lambda *step: shown.append(step))
    result = fit(start, scene[0], settings, held_out=scene[1], report=report)
    assert [step[:2] for step in shown] == [(1, 3), (2, 3), (3, 3)]
    first, last = (f"held out {result.history[k].psnr:.2f} dB" for k in (0, -1))
    assert f", {first} at 0, " in shown[1][2] and f", {last}, " in shown[2][2] and first != last
    assert shown[2][2].startswith(f"loss {result.history[-1].loss:.4f}, PSNR ")
    assert shown[2][2].endswith(f", {len(result.gaussians)} splats")


def test_more_splats_than_a_fit_may_grow_to_are_told(scene):
    start, settings = begin(scene, iterations=1, max_splats=2, **FAST)
    said = []
    result = fit(start, scene[0], settings, report=Watched(log=said.append))
    expected = f"{len(start)} first splats, more than max_splats 2: the fit keeps them all"
    assert said[:1] == [f"{expected} and adds none"] and len(result.gaussians) == len(start)


def test_a_seed_decides_every_bit(scene):
    start, settings = begin(scene, **{**BUSY, "iterations": 30})
    runs = [fit(start, scene[0], dataclasses.replace(settings, seed=seed)) for seed in (1, 1, 2)]
    assert same_bits(runs[0].gaussians, runs[1].gaussians)
    assert not same_bits(runs[0].gaussians, runs[2].gaussians)


def test_the_splats_that_a_fit_began_with_are_left_alone(scene):
    start, settings = begin(scene, iterations=3, sh_degree=0)
    before = {name: value.clone() for name, value in values(start).items()}
    fit(start, scene[0], settings)
    assert all(torch.equal(before[name], value) for name, value in values(start).items())


def test_a_world_far_from_its_origin_is_fitted_as_well():
    # Offsets that are whole numbers leave the fractions that float64 can hold at 1e6.
    figures = []
    for offset in ((0.0, 0.0, 0.0), (1e6, -2e6, 5e5)):
        truth, cameras = blobs(offset=offset), ring(offset=np.array(offset))
        start = from_points(truth.world_means(), kind="2d", sh_degree=0)
        settings = FitSettings(iterations=20, sh_degree=0, densify=False)
        result = fit(
            start, pictures(truth, cameras[1:]), settings, held_out=pictures(truth, cameras[:1])
        )
        figures.append([record.psnr for record in result.history])
    # Positions differ by 1e-10 after the offset; Adam's sign-like steps make 1e-2 dB of it at most.
    np.testing.assert_allclose(figures[0], figures[1], atol=0.05)


def test_float64_splats_far_from_zero_stay_where_they_are():
    # No learning rate, so no splat may move. float32 resolves 1e6 to 0.06; relative to the splats'
    # own middle it resolves 1e-7.
    rates = dict.fromkeys(
        ("lr_means", "lr_means_final", "lr_dc", "lr_rest", "lr_opacity", "lr_scales", "lr_quats"),
        0.0,
    )
    settings = FitSettings(kind="3d", iterations=1, sh_degree=0, densify=False, **rates)
    offset = (1e6, -2e6, 5e5)
    near = blobs(offset=offset).to(dtype=torch.float64)
    means = near.means + torch.tensor(offset, dtype=torch.float64)
    far = dataclasses.replace(near, means=means, origin=np.zeros(3))
    views = pictures(far, ring(offset=np.array(offset))[:2])
    result = fit(far, views, settings, held_out=views)
    assert np.abs(result.gaussians.world_means() - means.numpy()).max() < 1e-6
    assert result.history[0].psnr > 100


def test_scaling_the_world_changes_nothing():
    figures = []
    for scale in (1.0, 1e-3, 1e3):
        truth = blobs()
        truth = dataclasses.replace(truth, means=truth.means * scale, scales=truth.scales * scale)
        cameras = ring()
        moved = []
        for camera in cameras:
            pose = camera.world_to_camera.copy()
            pose[:3, 3] *= scale
            moved.append(dataclasses.replace(camera, world_to_camera=pose))
        near = 0.01 * scale
        images = [render(truth, c, near=near).color.clamp(0, 1).numpy() for c in moved]
        start = from_points(truth.world_means(), kind="2d", sh_degree=0)
        settings = FitSettings(
            iterations=20, sh_degree=0, densify=False, normal_from=0, distortion_from=0
        )
        result = fit(
            start, Views(moved[1:], images[1:]), settings, held_out=Views(moved[:1], images[:1])
        )
        figures.append([record.psnr for record in result.history])
    np.testing.assert_allclose(figures[0], figures[1], atol=0.05)
    np.testing.assert_allclose(figures[0], figures[2], atol=0.05)


def test_a_random_background_keeps_what_is_transparent_transparent():
    truth, cameras = blobs(), ring()
    views = pictures(truth, cameras, alpha=True)
    assert views.transparent
    start = from_points(truth.world_means(), kind="3d", sh_degree=0)
    result = fit(start, views, FitSettings(kind="3d", iterations=200, **FAST))
    alpha = render(result.gaussians, cameras[0]).alpha.numpy()
    assert np.abs(alpha - views.images[0][..., 3]).mean() < 0.05


def test_no_seconds_left_means_no_iteration(scene):
    start, settings = begin(scene, iterations=50, sh_degree=0)
    result = fit(start, scene[0], settings, held_out=scene[1], max_seconds=0)
    assert (result.stopped, result.iteration, len(result.history)) == ("time", 0, 1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_seconds", -1),
        ("max_seconds", float("nan")),
        ("checkpoint_seconds", -1),
        ("checkpoint_seconds", None),
    ],
)
def test_seconds_that_cannot_be_are_refused_by_name(scene, name, value):
    start, settings = begin(scene, iterations=1, sh_degree=0)
    with pytest.raises(ValueError, match=f"{name}: got {value}, expected seconds >= 0"):
        fit(start, scene[0], settings, **{name: value})


@pytest.mark.door
def test_a_held_out_view_that_renders_as_nan_is_no_equal_picture(scene, monkeypatch):
    def broken(gaussians, camera, **options):
        view = render(gaussians, camera, **options)
        if camera in scene[1].cameras:
            view.color[0, 0, 0] = float("nan")
        return view

    monkeypatch.setattr("attnwarp.fit.loop.render", broken)
    start, settings = begin(scene, iterations=1, sh_degree=0)
    with pytest.raises(RuntimeError, match="after 0 iterations: the held-out view '00.png'"):
        fit(start, scene[0], settings, held_out=scene[1])


@pytest.mark.parametrize("unit", [2.0**-12, 2.0**12])
def test_views_from_one_place_are_fitted_alike_in_any_unit(unit):
    """Powers of two leave every digit as it is."""
    far, grey = ring(1)[0].position, np.full((32, 32, 3), 0.2)
    settings = FitSettings(kind="3d", iterations=5, sh_degree=0, densify=False)

    def fitted(k):
        start = dataclasses.replace(blobs(), scales=k * blobs().scales, means=k * blobs().means)
        seen = Camera.look_at(k * far, (0, 0, 0), width=32, height=32, fov_y=40)
        return fit(start, Views([seen], [grey]), settings).gaussians

    one, other = fitted(1.0), fitted(unit)
    assert float((one.sh - blobs().sh).abs().max()) > 0.005  # 5 steps of 0.0025
    torch.testing.assert_close(other.sh, one.sh, rtol=0, atol=1e-5)
    torch.testing.assert_close(other.means / unit, one.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(other.scales / unit, one.scales, rtol=1e-4, atol=0)


def test_scales_without_a_learning_rate_stay_however_large_or_small(scene):
    start, settings = begin(scene, kind="3d", iterations=3, lr_scales=0, sh_degree=0, densify=False)
    start.scales[0], start.scales[1] = 1e5, 1e-9  # of an extent of 3
    result = fit(start, scene[0], settings)
    # They are kept as logarithms of float32.
    torch.testing.assert_close(result.gaussians.scales, start.scales, rtol=1e-5, atol=0)


def test_patience_ends_a_fit_that_no_longer_gains(scene):
    scene = with_four_held_out(scene)
    start, settings = begin(
        scene,
        iterations=500,
        sh_degree=0,
        densify=False,
        evaluate_every=10,
        patience=2,
        min_gain=50.0,
    )
    result = fit(start, scene[0], settings, held_out=scene[1])
    assert (result.stopped, result.iteration) == ("patience", 20)


def test_a_sitting_that_ends_between_evaluations_does_not_cost_patience(scene, tmp_path):
    scene = with_four_held_out(scene)
    start, settings = begin(
        scene, iterations=60, evaluate_every=20, patience=1, min_gain=0.05, **FAST
    )
    sitting(scene, start, settings, tmp_path, until=21)
    # One iteration gains no 0.05 dB; 20 may, or the uninterrupted fit ends there, too.
    parts = sitting(scene, start, settings, tmp_path)
    whole = fit(start, scene[0], settings, held_out=scene[1])
    assert (parts.stopped, parts.iteration) == (whole.stopped, whole.iteration)
    assert 21 in [record.iteration for record in parts.history]
    assert same_bits(parts.gaussians, whole.gaussians)


def test_a_measure_of_the_callers_own_is_part_of_the_curve(scene, tmp_path):
    start, settings = begin(scene, iterations=20, sh_degree=0, evaluate_every=10)
    result = fit(
        start,
        scene[0],
        settings,
        folder=tmp_path,
        measure=lambda g: {"largest": float(g.scales.max())},
    )
    assert [record.iteration for record in result.history] == [0, 10, 20]
    assert all(record.measures["largest"] > 0 for record in result.history)
    assert all(record.psnr is None for record in result.history)
    # Finished: taking it up again computes nothing and returns the same.
    again = fit(start, scene[0], settings, folder=tmp_path)
    assert again.history == result.history and same_bits(again.gaussians, result.gaussians)


@pytest.mark.door
@pytest.mark.parametrize(
    ("position", "value", "message"),
    [
        (0, "a.ply", "start: got str, expected attnwarp.Gaussians"),
        (1, [], "views: got list, expected attnwarp.fit.Views"),
        (2, {}, "settings: got dict, expected attnwarp.fit.FitSettings"),
    ],
)
def test_an_argument_of_another_type_is_named(scene, position, value, message):
    start, settings = begin(scene, iterations=1)
    arguments = [start, scene[0], settings]
    arguments[position] = value
    with pytest.raises(TypeError, match=message):
        fit(*arguments)


@pytest.mark.door
def test_the_pairs_of_a_fit_are_those_of_its_iterations_in_all_sittings(tmp_path, monkeypatch):
    """Oracle: three faint splats, far larger than the picture, meet each of its pixels."""
    one = dataclasses.replace(disc(50.0), opacities=torch.tensor([0.02]))
    start = one.select(torch.zeros(3, dtype=torch.int64))
    grey, held = (Views([view(x, side=16)], [np.full((16, 16, 3), 0.5)]) for x in (0, 1))
    settings = FitSettings(kind="2d", iterations=6, sh_degree=0, densify=False)
    asked = itertools.count()
    first = fit(
        start, grey, settings, held_out=held, folder=tmp_path, stop=lambda: next(asked) == 4
    )
    assert (first.iteration, first.pairs) == (4, 4 * 3 * 16 * 16)
    whole = fit(start, grey, settings, held_out=held, folder=tmp_path)
    assert (whole.iteration, whole.pairs) == (6, 6 * 3 * 16 * 16)
    # An iteration that renders twice is twice the work.
    monkeypatch.setattr(loop, "render", lambda *a, **k: (render(*a, **k), render(*a, **k))[0])
    assert fit(start, grey, settings).pairs == 2 * whole.pairs


def test_a_second_fit_into_a_folder_is_refused_while_the_first_goes_on(scene, tmp_path):
    start, settings = begin(scene, iterations=2, sh_degree=0)
    refusals = []

    def again(*state):
        with pytest.raises(InputError, match="another run writes to this folder") as caught:
            fit(start, scene[0], settings, folder=tmp_path)
        refusals.append(caught)

    result = fit(start, scene[0], settings, folder=tmp_path, report=Watched(step=again))
    assert refusals
    after = fit(start, scene[0], settings, folder=tmp_path)
    assert same_bits(after.gaussians, result.gaussians)


@pytest.mark.door
def test_a_checkpoint_of_other_settings_or_views_is_refused_by_name(scene, tmp_path):
    start, settings = begin(scene, iterations=5, sh_degree=0)
    fit(start, scene[0], settings, folder=tmp_path)
    with pytest.raises(ValueError, match=r"other settings \(ssim: 0.2, now 0.3\)") as caught:
        fit(start, scene[0], dataclasses.replace(settings, ssim=0.3), folder=tmp_path)
    # The library names the file; options are the command line's to advise.
    assert f"remove {tmp_path / CHECKPOINT} and {SPLATS} to begin again" in str(caught.value)
    assert "--" not in str(caught.value)
    with pytest.raises(ValueError, match="other views"):
        fit(start, scene[1], settings, folder=tmp_path)
    moved = dataclasses.replace(start, means=start.means + 0.01)
    with pytest.raises(ValueError, match="other first splats"):
        fit(moved, scene[0], settings, folder=tmp_path)


def test_a_checkpoint_of_a_setting_that_is_gone_is_refused_by_its_name(scene, tmp_path):
    start, settings = begin(scene, iterations=2, sh_degree=0)
    fit(start, scene[0], settings, folder=tmp_path)
    folder = Workdir(tmp_path, "a fit")
    state = folder.load(CHECKPOINT)
    folder.save(CHECKPOINT, {**state, "settings": {**state["settings"], "grow": 0.05}})
    with pytest.raises(ValueError, match=r"other settings \(grow: 0.05, now 'no setting'\)"):
        fit(start, scene[0], settings, folder=tmp_path)


def test_a_fit_that_is_lengthened_is_one_of_that_length_where_no_schedule_depends_on_it(
    scene, tmp_path
):
    """Oracle: a fit in one go, whose learning rate and losses are the same from its beginning."""
    level = {
        "densify": False,
        "lr_means_final": FitSettings().lr_means,
        "normal": 0.0,
        "distortion": 0.0,
    }
    start, settings = begin(scene, iterations=9, background="random", **level)
    fit(start, scene[0], settings, folder=tmp_path / "once")
    lines = []
    report = Watched(log=lines.append)
    for iterations in (4, 9):
        again = settings.changed(iterations=iterations)
        result = fit(start, scene[0], again, folder=tmp_path / "longer", report=report)
    assert result.iteration == 9
    assert (tmp_path / "longer" / SPLATS).read_bytes() == (tmp_path / "once" / SPLATS).read_bytes()
    (line,) = [line for line in lines if "planned with" in line]
    assert "planned with 4 iterations goes on to 9" in line
    with pytest.raises(ValueError, match=r"other settings \(iterations: 9, now 8\)"):
        fit(start, scene[0], settings.changed(iterations=8), folder=tmp_path / "longer")


def test_a_lengthened_fit_keeps_nothing_of_before_its_new_plans_last_refinement(scene, tmp_path):
    scene = with_four_held_out(scene)
    start, settings = begin(scene, iterations=20, evaluate_every=10, patience=9, sh_degree=0)
    sitting(scene, start, settings, tmp_path)
    result = sitting(scene, start, settings.changed(iterations=60), tmp_path, until=5)
    assert result.kept.iteration == result.iteration == 25  # of 30 with refinements


def test_splats_without_a_checkpoint_stay(scene, tmp_path):
    """A fit whose checkpoint was removed, or splats of another program."""
    start, settings = begin(scene, iterations=2, sh_degree=0)
    fit(start, scene[0], settings, folder=tmp_path)
    whole = (tmp_path / SPLATS).read_bytes()
    (tmp_path / CHECKPOINT).unlink()
    (tmp_path / SPLATS).write_bytes(b"somebody's own")
    with pytest.raises(ValueError, match=f"{SPLATS} is there without {CHECKPOINT}"):
        fit(start, scene[0], settings, folder=tmp_path)
    assert (tmp_path / SPLATS).read_bytes() == b"somebody's own"
    fit(start, scene[0], settings, folder=tmp_path, restart=True)
    assert (tmp_path / SPLATS).read_bytes() == whole


def test_a_restart_that_is_stopped_before_its_first_save_loses_nothing(scene, tmp_path):
    start, settings = begin(scene, iterations=2, sh_degree=0)
    fit(start, scene[0], settings, folder=tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def stop(*state):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(start, scene[0], settings, folder=tmp_path, restart=True, report=Watched(step=stop))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert fit(start, scene[0], settings, folder=tmp_path).iteration == 2


@pytest.mark.door
def test_no_splat_stays_larger_than_30_extents(scene):
    """Neither of a start with one, nor in a fit without densification."""
    start, settings = begin(scene, iterations=1, **FAST)
    start.scales[3] = 1000
    result = fit(start, scene[0], settings)
    assert float(result.gaussians.scales.max()) == pytest.approx(30 * result.extent, rel=1e-5)


def test_numbers_that_explode_end_in_a_clear_error(scene):
    start, settings = begin(scene, iterations=5, sh_degree=0, lr_dc=1e39)
    with pytest.raises(RuntimeError, match=r"after 1 iterations: .*lower the learning rates"):
        fit(start, scene[0], settings)


@pytest.mark.door
def test_splats_of_another_kind_or_degree_are_refused(scene):
    start, _ = begin(scene, sh_degree=0)
    with pytest.raises(ValueError, match=r"start: is of kind '2d', but settings.kind is '3d'"):
        fit(start, scene[0], FitSettings(kind="3d", sh_degree=0))
    with pytest.raises(ValueError, match=r"harmonics of degree 0, but settings.sh_degree is 3"):
        fit(start, scene[0], FitSettings())


@pytest.mark.door
def test_a_view_too_small_for_ssim_is_named_before_the_first_iteration(scene):
    start, settings = begin(scene, iterations=5, sh_degree=0)
    small = dataclasses.replace(ring(3)[1].resize(16, 8), name="small.png")
    views = Views([ring(3)[0], small], [np.zeros((32, 32, 3)), np.zeros((8, 16, 3))])
    with pytest.raises(ValueError, match=r"views: 'small.png' has 16 x 8 px, SSIM needs 11"):
        fit(start, views, settings)
    without = dataclasses.replace(settings, ssim=0.0)
    assert fit(start, views, without).iteration == 5


@pytest.mark.door
def test_views_that_show_nothing_of_the_splats_end_in_a_clear_error(scene):
    start, settings = begin(
        scene,
        kind="2d",
        sh_degree=0,
        iterations=60,
        densify_from=1 / 6,
        densify_every=1 / 6,
        densify_least=10,
        densify_until=1.0,
        prune_opacity=0.5,
    )
    start.means = start.means + 100
    with pytest.raises(
        RuntimeError, match="check that cameras and points are in one coordinate system"
    ):
        fit(start, scene[0], settings)


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "4d"}, "kind: got '4d'"),
        ({"iterations": 0}, "iterations: got 0, expected a whole number >= 1"),
        ({"iterations": 10.5}, "iterations: got 10.5, expected a whole number"),
        ({"ssim": 1.5}, r"ssim: got 1.5, expected a number in \[0, 1\]"),
        ({"lr_means": float("nan")}, "lr_means: got nan"),
        ({"densify": 1}, "densify: got 1, expected true or false"),
        ({"background": "blue"}, "background: got 'blue'"),
        ({"antialiased": True}, "antialiased: applies to kind '3d' only"),
        ({"iterations": True}, "iterations: got True"),
        ({"reset_opacity": 1}, "reset_opacity: got 1, expected a number in"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        FitSettings(**changes)


def test_defaults_that_depend_on_the_kind_follow_it():
    flat = FitSettings()
    solid = dataclasses.replace(flat, kind="3d")
    assert (flat.normal_weight, flat.opacity_floor) == (0.05, 0.05)
    assert (solid.normal_weight, solid.distortion_weight, solid.opacity_floor) == (0.0, 0.0, 0.005)


def test_harmonics_above_the_degree_in_use_take_no_part():
    """By the closed form of the layout: (degree + 1)^2 coefficients come first."""
    start = from_points(np.eye(3), kind="2d", sh_degree=3)
    start.sh += torch.arange(16.0)[:, None]
    model = Model(start, FitSettings(kind="2d"), 1.0)
    for degree, count in enumerate((1, 4, 9, 16)):
        assert torch.equal(model.gaussians(sh_degree=degree).sh, start.sh[:, :count])
    model.gaussians(sh_degree=0).sh.sum().backward()
    assert model.tensors["rest"].grad is None
