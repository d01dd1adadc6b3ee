# ruff: noqa: F811  (fixtures that are imported)
"""Oracles: the editor's own loop, view by view itself, renders of the splats, counts of draws."""

import importlib
import inspect
import json
import pkgutil
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_editors import nearest_steps
from tiny_methods import QUICK, close, depth_editor, editor, rows_of, run, scene  # noqa: F401
from tiny_scenes import cameras

from attnwarp import Camera, Gaussians, methods
from attnwarp.editing.editor import edit
from attnwarp.editing.inversion import ddim_invert
from attnwarp.editing.schedule import DDIM
from attnwarp.fit import Views
from attnwarp.io import read_ply
from attnwarp.methods import (
    METHODS,
    PRESETS,
    AttentionWarpingSettings,
    ByViewSettings,
    CorrespondingSettings,
    DGESettings,
    FusedSettings,
    GaussCtrlSettings,
    GuidedSettings,
    IGS2GSSettings,
    WarpedReferenceSettings,
    by_view,
    preset,
)
from attnwarp.methods.geometry import Geometry
from attnwarp.methods.pictures import to_bytes
from attnwarp.methods.work import Work
from attnwarp.render import render
from attnwarp.reporting import SILENT
from attnwarp.workdir import Workdir


def work_of(model, scene, editor, settings):
    folder = Workdir(Path("unused"), "an edit")
    return Work(model, scene, editor, "a bear", settings, "auto", folder, SILENT)


def alone(scene):
    model, views, images = scene
    return model, views[1:2], images[1:2]


def test_one_view_is_view_by_view(run, scene, depth_editor):
    one = alone(scene)
    plain = {"steps": 2, "iterations": 0}
    floor = run("by_view", ByViewSettings(**plain, start=(700, 980)), one).edited[0]
    assert np.array_equal(run("igs2gs", IGS2GSSettings(**plain), one).edited[0], floor)

    floor = run("by_view", ByViewSettings(**plain, start=(900, 900)), one).edited[0]
    assert close(run("dge", DGESettings(**plain, starts=(900,)), one).edited[0], floor)

    model, views, images = one
    settings = ByViewSettings(**plain)
    floor = by_view(model, views, images, depth_editor, "a bear", settings).edited[0]
    assert close(
        run("gaussctrl", GaussCtrlSettings(**plain, latents="random"), one).edited[0], floor
    )
    assert not close(run("gaussctrl", GaussCtrlSettings(**plain), one).edited[0], floor)  # inverted


SETTINGS = {
    "attention_warping": AttentionWarpingSettings(stages=1),
    "by_view": ByViewSettings(start=(700, 980)),
    "igs2gs": IGS2GSSettings(),
    "dge": DGESettings(batch=2),
    "gaussctrl": GaussCtrlSettings(latents="random", references=2, batch=2),
    "corresponding": CorrespondingSettings(self_share=0.7),
    "fused": FusedSettings(),
    "guided": GuidedSettings(),
    "warped_reference": WarpedReferenceSettings(),
}


@pytest.mark.parametrize("name", METHODS)
def test_identical_views_with_shared_noise_get_identical_edits(name, run, scene):
    model, views, images = scene
    twins = [Camera(views[1].K, views[1].world_to_camera, 32, 32, f"{k}.png") for k in range(3)]
    same = model, twins, [images[1]] * 3
    shared = replace(SETTINGS[name], steps=1, iterations=0, noise="shared")
    first, *others = run(name, shared, same).edited.values()
    assert len(others) == 2
    if name == "warped_reference":  # its source has another start
        first = others[0]
    assert all(close(first, other) for other in others)
    if name == "by_view":
        first, *others = run(name, replace(shared, noise="fresh"), same).edited.values()
        assert not any(close(first, other) for other in others)


@pytest.mark.parametrize("name", METHODS)
def test_splats_seen_only_where_masks_ignore_the_pictures_keep_their_bytes(name, run, scene):
    """Oracle: a loss that reads no pixel of a splat has no gradient in it, and Adam takes no step."""
    model, views, images = scene
    right = np.arange(32)[None].repeat(32, 0) >= 26
    magenta = [np.where(right[..., None], image, np.float32([1, 0, 1])) for image in images]
    hidden = model.means[:, 0] < -0.7
    quick = replace(QUICK[name], normal=0.0, distortion=0.0)

    def changed(**masks):
        tuned = run(name, quick, (model, views, magenta), **masks).gaussians
        return (tuned.sh != model.sh).any(dim=(1, 2))

    assert hidden.sum() == 3
    masked = changed(masks=[right] * 3)
    assert masked.any() and not masked[hidden].any()
    if name == "by_view":  # one shows that the pictures concern the splats, all tune alike
        assert changed()[hidden].all()


def test_no_feature_comes_from_what_the_sources_mask_ignores(scene, editor):
    """Oracle: where the warp without masks reads the source."""
    model, views, images = scene
    left = np.arange(32)[None].repeat(32, 0) < 16
    settings = AttentionWarpingSettings()

    def warp(*masks):
        work = work_of(model, Views(views, images, masks), editor, settings)
        return Geometry(work, settings.warp, None).warp(0, 1, model)

    whole, part = warp(), warp(left, None, None)
    read = whole.correspondence.xy[..., 0]
    assert torch.equal(part.mask, whole.mask & (read < 16)) and part.mask.any()
    assert (part.mask != whole.mask).any()


def test_view_by_view_with_shared_noise_is_the_editors_own_loop(run, scene, editor):
    settings = replace(QUICK["by_view"], noise="shared", iterations=0, batch=1, seed=4)
    result = run("by_view", settings)
    for view, picture in enumerate(scene[2]):
        expected = edit(editor, [picture], "a bear", steps=2, seed=4).images[0]
        assert np.array_equal(result.edited[view], to_bytes(expected))


@pytest.mark.parametrize(
    ("name", "off"), [("dge", {"plain_below": 1000}), ("gaussctrl", {"self_share": 1.0})]
)
def test_views_that_look_at_others_differ_from_views_alone(
    name, off, run, scene, editor, depth_editor
):
    settings = replace(SETTINGS[name], steps=2, iterations=0)
    together, apart = run(name, settings).edited, run(name, replace(settings, **off)).edited
    assert not any(close(together[view], apart[view]) for view in range(3))
    # What they are without each other is view by view.
    model, views, images = scene
    kind, start = (editor, (998, 998)) if name == "dge" else (depth_editor, None)
    alone = ByViewSettings(steps=2, iterations=0, start=start)
    floor = by_view(model, views, images, kind, "a bear", alone).edited
    assert all(close(apart[view], floor[view]) for view in range(3))


def test_published_timesteps_stand_for_the_share_of_the_picture_that_is_left(
    run, scene, editor, monkeypatch
):
    # At every step twice the signal that Stable Diffusion has for the same noise.
    alphas = 4 * editor.schedule.alphas / (1 + 3 * editor.schedule.alphas)
    with_its_own = run("dge", replace(SETTINGS["dge"], steps=4, iterations=0)).counters
    monkeypatch.setattr(editor, "schedule", DDIM(alphas, "epsilon", 1.0))
    clock = [700, 525, 349, 174]
    for name, settings in {
        "by_view": ByViewSettings(start=(700, 700)),
        "igs2gs": IGS2GSSettings(start=(700, 700)),
        "dge": DGESettings(starts=(700,), batch=2),
    }.items():
        steps = []
        handle = editor.unet.register_forward_pre_hook(
            lambda module, args, steps=steps: steps.append(int(args[1]))
        )
        try:
            result = run(name, replace(settings, steps=4, iterations=0), alone(scene))
        finally:
            handle.remove()
        assert list(dict.fromkeys(steps)) == nearest_steps(alphas, clock), name
        assert steps[0] > 800
    # As many steps with key views as on Stable Diffusion's own schedule.
    result = run("dge", replace(SETTINGS["dge"], steps=4, iterations=0))
    assert result.counters == with_its_own


# --- Instruct-GS2GS


def test_igs2gs_edits_every_view_in_every_round_from_the_render_as_tuned(
    run, scene, tmp_path, monkeypatch
):
    edits = []

    def noted(*args, **kwargs):
        edits.append((args[1][0], kwargs["start"], kwargs["pictures"][0]))
        return edit(*args, **kwargs)

    monkeypatch.setattr(methods.work, "edit", noted)
    settings = IGS2GSSettings(steps=1, iterations=7, every=3)
    result = run("igs2gs", settings, folder=tmp_path)
    assert len(edits) == 3 * 3  # after 0, 3 and 6 iterations
    model, views, images = scene
    states = [model, *(read_ply(tmp_path / f"rounds/{number}.ply") for number in (1, 2))]
    for number, state in enumerate(states):
        for view in range(3):
            guide, start, noised = edits[3 * number + view]
            assert np.array_equal(guide, images[view])
            expected = render(state, views[view]).color.clamp(0, 1).numpy()
            assert np.abs(noised - expected).max() < 1e-5
            name = Path(views[view].name).stem
            about = json.loads((tmp_path / f"rounds/{number + 1}/{name}.json").read_text())
            assert about["start"] == start
    starts = {start for _, start, _ in edits}
    assert len(starts) > 5
    assert min(starts) >= 700
    assert max(starts) <= 980
    assert result.counters["rounds"] == 3
    # Seven iterations of rounds of 3, 3 and 1: every view is tuned on twice, one of them again.
    tuned = json.loads((tmp_path / "result.json").read_text())["tuned"]
    assert sorted(tuned.values()) == [2, 2, 3]


def test_timesteps_are_drawn_evenly_with_both_ends(scene, editor):
    model, views, images = scene
    work = work_of(model, Views(views, images), editor, IGS2GSSettings())
    drawn = [work.timestep(number, view, (20, 29)) for number in range(100) for view in range(10)]
    counts = np.bincount(drawn, minlength=30)
    assert counts[:20].sum() == 0
    assert ((counts[20:] - 100) ** 2 / 100).sum() < 33.7  # chi squared, 9 degrees, p = 1e-4
    noises = torch.stack([work.noise(number, [view])[0] for number in (0, 1) for view in (0, 1)])
    assert torch.equal(noises[1], work.noise(0, [0, 1])[1])  # whoever is beside it
    correlations = np.corrcoef(noises.flatten(1).numpy())
    assert np.abs(correlations - np.eye(4)).max() < 0.2  # 1024 values: 6 sigma


def test_depth_shows_no_splat_that_no_picture_shows(editor):
    """Oracle: the plane of the wall. A disc hangs 0.1 before the first of two cameras 40 apart."""
    view = {"width": 32, "height": 32, "fov_y": 40, "up": (0, 1, 0)}
    views = [Camera.look_at((x, 0, 20), (x, 0, 0), **view) for x in (-20.0, 20.0)]
    discs = Gaussians(
        "2d",
        torch.tensor([[0, 0, 0], [-20, 0, 19.9]]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        torch.tensor([[500.0, 500.0], [0.02, 0.02]]),
        torch.ones(2),
        torch.zeros(2, 1, 3),
    )
    scene = Views(views, [np.zeros((32, 32, 3), np.uint8)] * 2)
    work = work_of(discs, scene, editor, ByViewSettings())
    assert np.allclose(work.depth(0, discs), 20, rtol=1e-4)


def test_the_published_numbers():
    released, improved = preset("igs2gs", "released"), preset("igs2gs", "improved")
    assert (released.iterations, improved.iterations, released.every) == (7500, 3000, 2500)
    assert (released.text_guidance, released.image_guidance) == (12.5, 1.5)
    assert (released.start, released.l1, released.ssim) == ((700, 980), 1.0, 0.2)
    of_dge = preset("dge", "released")
    assert (of_dge.text_guidance, of_dge.image_guidance, of_dge.steps) == (7.5, 1.5, 20)
    assert (of_dge.views, of_dge.batch, of_dge.every, of_dge.iterations) == (20, 5, 500, 1500)
    assert (of_dge.l1, of_dge.perceptual, of_dge.plain_below, of_dge.epipolar) == (10, 10, 100, 1)
    of_gaussctrl = preset("gaussctrl", "released")
    assert (of_gaussctrl.views, of_gaussctrl.references, of_gaussctrl.self_share) == (40, 4, 0.6)
    assert (of_gaussctrl.text_guidance, of_gaussctrl.steps) == (5.0, 20)


# --- DGE


def test_dge_draws_other_views_each_round_and_a_key_view_of_each_batch_at_each_step(
    run, scene, tmp_path
):
    model, _, _ = scene
    views = cameras(7)
    settings = DGESettings(
        steps=4, iterations=2, every=1, views=4, batch=2, starts=(998, 299), perceptual=0.0
    )
    run("dge", settings, (model, views, None), folder=tmp_path)
    chosen, keys = [], []
    for number in (1, 2):
        names = sorted(path.stem for path in tmp_path.glob(f"rounds/{number}/*.png"))
        about = json.loads((tmp_path / f"rounds/{number}/{names[0]}.json").read_text())
        # Steps from 998: 998, 748, 498, 248. From 299: 299, 224, 149 and 74, where each is alone.
        assert about["start"] == (998 if number == 1 else 299)
        assert len(about["keys"]) == (4 if number == 1 else 3)
        chosen.append(tuple(names))
        # In a row the order by angle is that by name, so that a batch is a half of it.
        halves = [set(names[:2]), set(names[2:])]
        for pair in about["keys"]:
            (a,), (b,) = ([k for k in (0, 1) if Path(key).stem in halves[k]] for key in pair)
            assert a != b
            keys.append(tuple(pair))
    assert chosen[0] != chosen[1]
    assert len(set(keys)) > 3


# --- GaussCtrl


def test_gaussctrl_draws_ten_views_and_a_reference_of_each_quarter():
    from attnwarp.methods.algorithms.gaussctrl import _choice, _quarters, _spread_draw

    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        views = _spread_draw(range(101), 4, 40, generator)
        assert views == sorted(set(views))
        assert np.histogram(views, bins=[0, 26, 51, 76, 101])[0].tolist() == [10] * 4
        for part in _quarters(views, 4):
            (reference,) = _choice(part, 1, generator)
            assert len(part) == 10
            assert reference in part
    assert _spread_draw(range(7), 4, 40, generator) == list(range(7))


def test_gaussctrl_inverts_without_guidance_and_edits_with_references(run, depth_editor):
    rows, _ = rows_of(depth_editor.unet, lambda: run("gaussctrl"))
    # Two of three views are references. First batch: two views, both or one of them references.
    # Each inversion has one row a step, each step of an edit two branches of references and views.
    inversions, edits = [n for n in rows if n == 1], [n for n in rows if n > 1]
    assert len(inversions) == 3 * 2
    assert edits == [2 * (2 + 2)] * 2 + [2 * (2 + 1)] * 2
    assert depth_editor.text_guidance == 3.0
    texts = []
    embed = depth_editor.embed
    depth_editor.embed = lambda prompts: texts.append(list(prompts)) or embed(prompts)
    try:
        words = {"negative_prompt": "red", "suffix": ", best"}
        run("gaussctrl", preset("gaussctrl", "paper", steps=2, iterations=0, **words))
    finally:
        del depth_editor.embed
    assert texts == [[""]] * 3 + [["red", "a bear, best"]]
    assert (depth_editor.text_guidance, depth_editor.negative_prompt) == (3.0, "")


@pytest.mark.parametrize(("spread", "kind"), [(0.5, "sample"), (2.0, "epsilon")])
def test_inversion_from_noised_latents_follows_the_exact_flow(spread, kind):
    """For latents with a normal distribution of spread s, the network is known and so is the flow:
    x keeps its ratio to the standard deviation sqrt(a s^2 + 1 - a) (Song et al. 2021, eq. 14).
    """
    alphas = torch.linspace(0.999, 0.001, 1000, dtype=torch.float64)
    schedule = DDIM(alphas, kind, 1.0)

    def predict(x, timestep):
        # The inversion's network is asked at the latents that the step starts from.
        a = alphas[states[len(asked)]]
        asked.append(timestep)
        clean = a.sqrt() * spread**2 / (a * spread**2 + 1 - a) * x
        return clean if kind == "sample" else (x - a.sqrt() * clean) / (1 - a).sqrt()

    asked, states = [], list(range(9, 999))
    x = torch.randn((1, 2, 4, 4), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    result = ddim_invert(schedule, predict, x, states[:0:-1], begin=9)
    assert asked == states[1:]
    variance = alphas * spread**2 + 1 - alphas
    expected = x * (variance[998] / variance[9]).sqrt()
    assert (result / expected - 1).abs().max() < 0.01
    assert (result / x - 1).abs().min() > 0.3


def test_gaussctrl_inverts_an_editor_that_predicts_the_picture_from_its_lowest_timestep(
    run, depth_editor, monkeypatch
):
    schedule = depth_editor.schedule
    monkeypatch.setattr(
        depth_editor, "schedule", DDIM(schedule.alphas, "sample", schedule.final_alpha)
    )
    steps = []
    handle = depth_editor.unet.register_forward_pre_hook(
        lambda module, args: steps.append((args[0].shape[0], int(args[1])))
    )
    try:
        result = run("gaussctrl", replace(QUICK["gaussctrl"], steps=3, iterations=0))
    finally:
        handle.remove()
    first, second, third = depth_editor.schedule.timesteps(3)
    inversions = [timestep for rows, timestep in steps if rows == 1]
    assert inversions == [second, first] * 3
    assert [timestep for rows, timestep in steps if rows > 1] == [first, second, third] * 2
    assert result.counters["network_rows"] == sum(rows for rows, _ in steps)


def test_the_controlnets_attention_is_aligned_where_the_settings_say(run):
    quick = replace(QUICK["gaussctrl"], iterations=0, latents="random")
    plain = run("gaussctrl", quick).edited
    aligned = run("gaussctrl", replace(quick, control_share=0.0)).edited
    assert not any(close(plain[view], aligned[view]) for view in range(3))


def test_every_method_has_settings_and_presets():
    assert set(METHODS) == set(methods.PRESETS)
    for presets in PRESETS.values():
        for settings in presets.values():
            text = json.dumps(settings.to_dict())
            assert type(settings).from_dict(json.loads(text)) == settings


def test_no_module_is_hidden_by_a_function_of_its_name():
    """Oracle: the interpreter's table of modules."""
    import attnwarp

    names = [info.name for info in pkgutil.walk_packages(attnwarp.__path__, "attnwarp.")]
    # The package warp is an extra's.
    own = [n for n in names if not n.endswith("__main__") and "gpu" not in n]
    modules = {n: importlib.import_module(n) for n in own}
    assert "attnwarp.methods.algorithms.attention_warping" in modules
    for name, module in modules.items():
        parent, _, last = name.rpartition(".")
        assert getattr(sys.modules[parent], last) is module, name


@pytest.mark.parametrize("name", METHODS)
def test_each_method_has_its_documentation_its_settings_and_its_own_keywords(name):
    method, of_settings = METHODS[name], type(next(iter(PRESETS[name].values())))
    parameters = inspect.signature(method).parameters
    first = ["gaussians", "cameras", "images", "editor", "instruction", "settings"]
    assert list(parameters)[:6] == first and list(parameters)[-1] == "options"
    assert parameters["settings"].annotation == f"{of_settings.__name__} | None"
    assert method.__name__ == name and "Example:" in method.__doc__
    warped = {f.name for f in fields(of_settings)} >= {"warp"}
    assert warped == ("warps" in parameters) and not {"work", "self"} & parameters.keys()
