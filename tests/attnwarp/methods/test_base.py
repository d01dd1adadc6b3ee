# ruff: noqa: F811  (fixtures that are imported)
"""Oracles: rows counted by hooks on the network, bytes of files, a clock that counts."""

import contextlib
import json
import math
import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import held_pictures
import numpy as np
import pytest
import torch
from edit_folders import Killed, Watched, events, files
from further import further
from tiny_methods import QUICK, depth_editor, editor, rows_of, run, scene  # noqa: F401

from attnwarp import Camera
from attnwarp.errors import InputError, InputWarning
from attnwarp.io import FileFormatError, read_ply
from attnwarp.methods import (
    METHODS,
    Budget,
    ByViewSettings,
    DGESettings,
    GaussCtrlSettings,
    IGS2GSSettings,
    dge,
    gaussctrl,
    igs2gs,
    preset,
)
from attnwarp.methods import base as run_module
from attnwarp.methods.algorithms.by_view import ByView


@pytest.fixture(scope="module")
def finished():
    """Whole runs by method."""
    return {}


@pytest.fixture
def whole(finished, run, editor, depth_editor, tmp_path_factory):
    """The folder, the rows through the network and the result of a whole run of a method."""

    def of(name):
        if name not in finished:
            folder = tmp_path_factory.mktemp(name)
            network = (depth_editor if name == "gaussctrl" else editor).unet
            counted = rows_of(network, lambda: run(name, folder=folder, checkpoint_seconds=0))
            finished[name] = folder, *counted
        return finished[name]

    return of


@pytest.mark.parametrize("name", METHODS)
def test_counters_are_what_hooks_and_files_count(name, whole, run, editor, depth_editor):
    folder, rows, result = whole(name)
    assert result.counters["network_rows"] == sum(rows) > 0
    assert sum(part.rows for part in result.rounds) == sum(rows)
    assert result.counters["edits"] == len(list(folder.glob("rounds/*/*.png")))
    assert result.counters["views"] == len(list(folder.glob("views/*.png"))) == len(result.edited)
    iterations = QUICK[name].iterations * getattr(QUICK[name], "stages", 1)
    assert result.counters["iterations"] == iterations
    tuned = json.loads((folder / "result.json").read_text())["tuned"]
    assert sum(tuned.values()) == iterations
    assert result.cut is None
    assert torch.allclose(read_ply(folder / "edited.ply").sh, result.gaussians.sh, atol=1e-6)
    assert {"edit", "write", "tune", "render"} <= set(result.seconds)
    assert result.seconds == json.loads((folder / "times.json").read_text())
    # The folder's views are the result's, and a second call makes nothing anew.
    before = files(folder)
    network = (depth_editor if name == "gaussctrl" else editor).unet
    rows, again = rows_of(network, lambda: run(name, folder=folder))
    assert not rows
    assert files(folder) == before
    for view, pixels in result.edited.items():
        assert np.array_equal(again.edited[view], pixels)
    assert all(again.seconds[part] == result.seconds[part] for part in ("edit", "tune"))


def test_the_first_estimate_of_the_time_left_is_right_within_a_factor_of_two(run, monkeypatch):
    """Oracle: a clock on which a step of denoising takes fifty times as long as an iteration."""
    now, told = 0.0, []

    def step(done, total, text, left):
        nonlocal now
        told.append((now, left))
        now += 0.3 if "tuning" in text else 15

    monkeypatch.setattr("attnwarp.workdir.time", SimpleNamespace(perf_counter=lambda: now))
    settings = replace(QUICK["igs2gs"], iterations=30)
    run("igs2gs", settings, report=Watched(step))
    first, left = next((at, left) for at, left in told if not math.isnan(left))
    assert 0.5 < left / (told[-1][0] - first) < 2


def test_lifting_is_told_of_and_begins_anew_when_it_is_killed(run, tmp_path):
    """Oracles: 2 steps of 3 edits, 3 sweeps of 2 and of 3 views, and twice 2 iterations; the bytes
    of a run that was left alone."""
    settings = replace(QUICK["attention_warping"], training="lifted")

    def told(folder, moment=math.inf):
        steps = []

        def step(done, total, text, left):
            assert total == 2 * 3 + 3 * (2 + 3) + 2 * 2
            steps.append((done, text))
            if len(steps) == moment:
                raise Killed

        with contextlib.suppress(Killed):
            run(
                "attention_warping", settings, folder=tmp_path / folder, report=Watched(step),
                checkpoint_seconds=0,
            )  # fmt: skip
        return steps

    whole = told("whole")
    last = [done for done, text in whole if "round 2 of 2: tuning" in text]
    assert last == [*range(14, 26)]
    told("killed", [done for done, _ in whole].index(20))
    assert told("killed")[-1] == (25, "done")
    assert files(tmp_path / "killed") == files(tmp_path / "whole")


# --- killed and resumed


def killed_at(run, name, folder, moment):
    """Die at a step of progress or at a write, before it or after it; whether it came so far."""
    with pytest.MonkeyPatch.context() as patch:
        watch, _ = events(patch, moment)
        try:
            run(name, folder=folder, report=Watched(watch), checkpoint_seconds=0)
        except Killed:
            return True
    return False


@pytest.mark.parametrize(
    "name", further("attention_warping", *sorted({*METHODS} - {"attention_warping"}))
)
def test_killed_at_a_random_moment_and_resumed_it_gives_the_same_bytes(name, whole, run, tmp_path):
    moment = int(np.random.default_rng([*name.encode()]).integers(2, 40))
    assert killed_at(run, name, tmp_path, moment)
    folder, _, result = whole(name)
    assert files(tmp_path) != files(folder)
    resumed = run(name, folder=tmp_path, checkpoint_seconds=0)
    assert files(tmp_path) == files(folder)
    assert resumed.counters == result.counters


def test_splats_that_were_cut_are_made_whole_and_a_cut_picture_is_said_to_be(whole, run, tmp_path):
    """Oracle: the bytes of the run that was left alone."""
    name = "by_view"
    folder = whole(name)[0]
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    splats, picture = tmp_path / "rounds/1.ply", next((tmp_path / "renders/after").iterdir())
    splats.write_bytes(splats.read_bytes()[:-40])
    run(name, folder=tmp_path)
    assert files(tmp_path) == files(folder)
    picture.write_bytes(picture.read_bytes()[:-40])
    with pytest.raises(FileFormatError, match=f"{picture.name}: damaged; remove it, it is made"):
        run(name, folder=tmp_path)
    picture.unlink()
    run(name, folder=tmp_path)
    assert files(tmp_path) == files(folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_killed_again_and_again_it_gives_the_same_bytes(name, whole, run, tmp_path):
    for moment in np.random.default_rng(0).integers(2, 30, 40).tolist():
        if not killed_at(run, name, tmp_path, moment):
            break
    run(name, folder=tmp_path, checkpoint_seconds=0)
    assert files(tmp_path) == files(whole(name)[0])


# --- budget


@pytest.mark.parametrize("name", further("igs2gs", *sorted({*METHODS} - {"igs2gs"})))
def test_no_more_rows_go_through_the_network_than_the_budget_has(
    name, whole, run, editor, depth_editor, tmp_path
):
    network = (depth_editor if name == "gaussctrl" else editor).unet
    folder, all_rows, full = whole(name)
    limited = Budget(network_rows=sum(all_rows) - 1)
    steps = []
    rows, result = rows_of(
        network,
        lambda: run(
            name, folder=tmp_path, budget=limited, report=Watched(lambda *step: steps.append(step))
        ),
    )
    assert steps[-1][2] == "cut short by its network rows" and steps[-1][0] < steps[-1][1]
    assert sum(rows) == result.counters["network_rows"] < sum(all_rows)
    assert result.cut == "network_rows"
    # The last batch of edits is missing, and those before are the whole run's.
    edits = [path.relative_to(tmp_path) for path in tmp_path.glob("rounds/*/*.png")]
    assert len(edits) == result.counters["edits"] < full.counters["edits"]
    assert len(edits) > 0
    for path in edits:
        assert (tmp_path / path).read_bytes() == (folder / path).read_bytes()
    rows, again = rows_of(network, lambda: run(name, folder=tmp_path, budget=limited))
    assert not rows
    assert again.counters == result.counters


def test_no_budget_is_a_whole_run(whole, run):
    result, full = run("by_view", budget=None), whole("by_view")[2]
    assert result.cut is None
    assert result.counters == full.counters


def test_a_missing_edit_of_a_run_that_was_cut_is_made_again(whole, run, tmp_path):
    """Oracle: the bytes before it was removed."""
    rows = whole("igs2gs")[2].counters["network_rows"]
    cut = Budget(network_rows=rows * 5 // 6)
    run("igs2gs", folder=tmp_path, budget=cut)
    before = files(tmp_path)
    path = next(iter(sorted(tmp_path.glob("rounds/1/*.png"))))
    path.unlink()
    with pytest.warns(InputWarning, match="missing; the view is edited again"):
        run("igs2gs", folder=tmp_path, budget=cut)
    assert files(tmp_path) == before


def test_igs2gs_with_rows_for_a_part_of_a_round_ends_after_its_tuning(run, whole):
    rows = whole("igs2gs")[2].counters["network_rows"]
    assert rows == 2 * 3 * 2 * 3  # two rounds of three views, two steps of three branches
    result = run("igs2gs", budget=Budget(network_rows=rows * 5 // 6))
    assert (result.counters["edits"], result.counters["iterations"]) == (5, 5)
    result = run("igs2gs", budget=Budget(network_rows=rows // 2))
    assert (result.counters["edits"], result.counters["iterations"]) == (3, 3)


class Clock:
    """Each look at it takes a hundredth of a second."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        self.now += 0.01
        return self.now


def test_no_iteration_begins_once_the_seconds_are_spent(run, scene, tmp_path, monkeypatch):
    import time

    monkeypatch.setattr(time, "perf_counter", Clock())
    long = replace(QUICK["igs2gs"], iterations=10_000, every=10_000)
    result = run("igs2gs", long, folder=tmp_path, budget=Budget(seconds=1.0))
    assert result.cut == "seconds"
    assert 0 < result.counters["iterations"] < 100
    assert len(result.edited) == 3
    # Files and renders are not counted, nor is the look at the clock that ends it.
    assert 1.0 <= sum(result.seconds[part] for part in ("edit", "tune")) < 1.05
    again = run("igs2gs", long, folder=tmp_path, budget=Budget(seconds=1.0))
    assert again.counters == result.counters

    nothing = run("igs2gs", long, budget=Budget(seconds=0.0))
    assert nothing.edited == {}
    assert torch.allclose(nothing.gaussians.means, scene[0].means, atol=1e-6)
    assert nothing.counters["iterations"] == nothing.counters["network_rows"] == 0


# --- arguments


def test_arguments_that_do_not_fit_are_named(run, scene, editor, depth_editor, tmp_path):
    model, views, images = scene
    with pytest.raises(ValueError, match="editor: igs2gs is made for InstructPix2Pix"):
        igs2gs(model, views, images, depth_editor, "a bear")
    with pytest.raises(ValueError, match="editor: dge is made for InstructPix2Pix"):
        dge(model, views, images, depth_editor, "a bear")
    with pytest.raises(ValueError, match="editor: gaussctrl is made for a depth ControlNet"):
        gaussctrl(model, views, images, editor, "a bear")
    with pytest.raises(
        TypeError, match="settings: got IGS2GSSettings, expected attnwarp.methods.DGESettings"
    ):
        run("dge", IGS2GSSettings())
    with pytest.raises(ValueError, match="checkpoint_seconds: got None"):
        run("by_view", checkpoint_seconds=None)
    with pytest.raises(ValueError, match="option: got 'reprt'.*'report'"):
        run("by_view", reprt=print)
    with pytest.raises(ValueError, match="option: got 'source'"):
        run("igs2gs", source=1)
    with pytest.raises(ValueError, match="image_guidance: this editor has none"):
        run("gaussctrl", GaussCtrlSettings(image_guidance=1.5))
    small = [views[0], *(view.resize(8, 8) for view in views[1:])]
    with pytest.raises(ValueError, match=f"views: '{views[1].name}' has 8 x 8 px, SSIM needs 11"):
        # Before the first round's edits.
        igs2gs(model, small, None, editor, "a bear", replace(QUICK["igs2gs"], ssim=0.2), folder=tmp_path / "ssim")  # fmt: skip
    wide = [*views[:2], Camera.look_at((0, 0, 3), (0, 0, 0), width=64, height=32, fov_y=40, up=(0, 1, 0))]  # fmt: skip
    with pytest.raises(ValueError, match="cameras: dge edits views together, got edits of 32 x 32 and 64 x 32"):  # fmt: skip
        dge(model, wide, None, editor, "a bear", QUICK["dge"])
    for seconds in (-1, np.inf, np.nan, "10"):
        with pytest.raises(ValueError, match=f"seconds: got {seconds!r}, expected a number >= 0"):
            Budget(seconds=seconds)
    with pytest.raises(ValueError, match="network_rows: got 2.5, expected a whole number >= 0"):
        Budget(network_rows=2.5)
    for field in ("suffix", "negative_prompt", "source_prompt", "perceptual_encoder"):
        with pytest.raises(ValueError, match=f"{field}: got 2024, expected a string"):
            preset("gaussctrl", **{field: 2024})
    with pytest.raises(ValueError, match="method: got 'dgee'.*dge"):
        preset("dgee")
    for wrong in ((9, 3), (700, 1000)):
        with pytest.raises(ValueError, match=r"start: got \[\d+, \d+\], .* in \[0, 999\]"):
            IGS2GSSettings(start=wrong)


@pytest.mark.door
@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("dge", replace(QUICK["dge"], steps=20, starts=(998, 10)), "starts: 10 .* for 20 steps"),
        ("igs2gs", IGS2GSSettings(start=(18, 980)), "start: 18 .* for 20 steps"),
        ("by_view", ByViewSettings(start=(18, 980)), "start: 18 .* for 20 steps"),
        ("dge", DGESettings(perceptual_encoder="bogus"), "encoder 'bogus': unknown"),
    ],
)
def test_settings_that_a_run_cannot_have_are_named_before_any_work(
    name, settings, message, run, editor, tmp_path
):
    def refused():
        with pytest.raises(ValueError, match=message):
            run(name, settings, folder=tmp_path)

    rows, _ = rows_of(editor.unet, refused)
    assert not rows
    assert not any(tmp_path.iterdir())


def test_the_lowest_start_that_the_steps_fit_below_is_taken(run):
    one_round = replace(QUICK["dge"], iterations=0)
    run("igs2gs", IGS2GSSettings(steps=3, iterations=0, start=(2, 2)))  # timesteps 2, 1 and 0
    # A start of a round that does not come is not asked for.
    assert run("dge", replace(one_round, steps=3, starts=(2, 0))).counters["rounds"] == 1


@pytest.mark.door
def test_a_folder_of_another_method_or_budget_is_refused_by_name(run, tmp_path):
    none = {"steps": 2, "iterations": 0}
    run("by_view", ByViewSettings(**none), folder=tmp_path)
    with pytest.raises(InputError, match=r'method \("by_view", now "igs2gs"\)'):
        run("igs2gs", IGS2GSSettings(**none), folder=tmp_path)
    with pytest.raises(InputError, match=r"budget\.seconds \(null, now 5\.0\)"):
        run("by_view", ByViewSettings(**none), folder=tmp_path, budget=Budget(seconds=5))


@pytest.mark.door
@pytest.mark.parametrize("what", ["views", "iterations", "end"])
def test_a_method_that_works_otherwise_than_planned_is_ended(scene, editor, what):
    class Fickle(ByView):
        runs = 0

        def run(self, loop):
            self.runs += 1
            later = self.runs > 1
            views = [1] if later and what == "views" else [0]
            edit = partial(self.edit, views)
            loop.edit(0, views, edit, rows=len(views))
            if not (later and what == "end"):
                loop.tune(0, views, 1 + (later and what == "iterations"))

    model, views, images = scene
    settings = replace(QUICK["by_view"], iterations=1)
    with pytest.raises(RuntimeError, match=r"fickle: its run calls .*, planned was \('\w+', 0, "):
        run_module.run(
            "fickle", Fickle, ByViewSettings, model, views, images, editor, "red", settings
        )


def test_a_budget_of_another_type_is_named(run):
    with pytest.raises(TypeError, match=r"budget: got dict, expected attnwarp.methods.Budget"):
        run("by_view", budget={"seconds": 3})


def test_splats_that_no_segment_marks_keep_their_bytes(run, scene, tmp_path):
    left = np.zeros((32, 32), dtype=bool)
    left[:, :16] = True
    before = scene[0]
    settings = ByViewSettings(steps=1, iterations=6)
    x = before.world_means()[:, 0]  # the cameras look at -0.2 to 0.2
    for folder, outside in (("kept", {}), ("tuned", {"tune_outside": True})):
        result = run("by_view", settings, segments=[left] * 3, folder=tmp_path / folder, **outside)
        moved = (result.gaussians.sh != before.sh).flatten(1).any(dim=1).numpy()
        assert moved[x < -0.6].all()
        assert moved[x > 0.6].all() if outside else not moved[x > 0.6].any()
        marked = json.loads((tmp_path / folder / "manifest.json").read_text())
        assert ("tuned" in marked) == (not outside)


@pytest.mark.parametrize("held", [0, 1, 8])
def test_of_the_pictures_a_round_tunes_on_as_many_are_kept_as_fit(run, monkeypatch, held):
    """Oracle: references that do not hold their objects."""
    counts = held_pictures.watch(monkeypatch, run_module, held * 32 * 32 * 3 * 4)
    run("by_view", ByViewSettings(steps=1, iterations=9, perceptual=0))
    views = 3
    # Edit PSNR makes each view's once more.
    assert max(counts[:-views]) == {0: 1, 1: 2, 8: views}[held]
    assert len(counts) == views + {0: 9, 1: 7, 8: views}[held]
