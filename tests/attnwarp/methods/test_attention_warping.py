"""Oracles: the editor's own loop, a float64 pass written out with its geometry, counts by hooks, bytes of files."""

import copy
import functools
import hashlib
import json
import shutil
import time
import weakref
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_models
import torch
from edit_folders import Killed, Watched, events, files
from further import further
from PIL import Image
from tiny_editors import nearest_steps
from tiny_methods import rows_of
from tiny_scenes import cameras, pictures, splats

import attnwarp.warp
from attnwarp import Camera, Gaussians
from attnwarp.digest import digest
from attnwarp.editing.editor import edit, shared_noise
from attnwarp.editing.schedule import DDIM
from attnwarp.errors import InputError, InputWarning
from attnwarp.fit import FitSettings
from attnwarp.io import read_image, read_ply
from attnwarp.io.images import encode_png
from attnwarp.methods import attention_warping, preset, tuning
from attnwarp.methods.pictures import to_bytes
from attnwarp.methods.tuning import Tuning
from attnwarp.trial import disc
from attnwarp.warp import Surface, warp_surfaces

QUICK = preset("attention_warping", stages=2, views_per_stage=2, steps=2, iterations=3)
ONE = replace(QUICK, stages=1, steps=1, iterations=0)
"""One stage of one step, for what neither tuning nor a second step tells."""
IDEAS = {"noise": "surface", "decay": "late"}
FLAT = Surface(np.full((32, 32), 2.0), np.broadcast_to([0.0, 0, -1], (32, 32, 3)))


def plan(result):
    """Plan of who was edited when, by the result's rounds: the source is the first of the first."""
    first, *others = [part.views for part in result.rounds]
    return SimpleNamespace(
        source=first[0],
        stages=[first[1:], *others],
        targets=[*first[1:], *(view for part in others for view in part)],
        edited=[*first, *(view for part in others for view in part)],
    )


def record(folder, name):
    """The record of a view's edit."""
    (path,) = folder.glob(f"rounds/*/{name}.json")
    return json.loads(path.read_text())


def run(scene, editor, folder=None, settings=QUICK, words="a bear", **more):
    model, views, images = scene
    return attention_warping(model, views, images, editor, words, settings, folder=folder, **more)


PROGRESS = []
"""Reports of the finished edit."""


@pytest.fixture(scope="module")
def finished(scene, editor, tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    PROGRESS.clear()
    return run(scene, editor, folder, report=Watched(lambda *step: PROGRESS.append(step))), folder


@pytest.mark.slow
def test_the_gpu_backend_ends_with_the_same_pictures(finished, scene, editor):
    result, _ = finished
    other = run(scene, editor, backend="gpu")
    for view, picture in result.edited.items():
        assert np.abs(other.edited[view].astype(int) - picture).max() <= 1
    for mine, theirs in zip(
        pictures(other.gaussians, scene[1]), pictures(result.gaussians, scene[1]), strict=True
    ):
        assert np.abs(to_bytes(mine).astype(int) - to_bytes(theirs)).max() <= 1


def test_the_source_is_edited_as_the_editor_alone_does(finished, scene, editor):
    result, folder = finished
    alone = edit(editor, [scene[2][0]], "a bear", steps=2, seed=0).images[0]
    assert np.array_equal(result.edited[0], to_bytes(alone))
    assert np.array_equal(read_image(folder / "rounds/1/v0.png"), to_bytes(alone))


def test_a_view_at_the_sources_place_gets_the_sources_edit(scene, editor):
    model, views, images = scene
    twin = Camera(views[0].K, views[0].world_to_camera, 32, 32, "twin")
    settings = replace(ONE, a0=1.0, decay="constant")
    result = attention_warping(
        model, [views[0], twin], [images[0], images[0]], editor, "a bear", settings
    )
    assert np.array_equal(result.edited[0], result.edited[1])


def test_a_warp_from_outside_takes_the_place_of_the_splats_own(scene, editor, tmp_path):
    model, views, images = scene
    # The identity, which no geometry gives for two cameras apart.
    identity = warp_surfaces(views[0], views[0], FLAT, FLAT)
    pair = (model, views[:2], [images[0], images[0]])
    settings = replace(ONE, a0=1.0, decay="constant")
    given = run(pair, editor, tmp_path, settings, warps=lambda source, target: identity)
    own = run(pair, editor, settings=settings)
    assert np.array_equal(given.edited[0], given.edited[1])
    assert not np.array_equal(own.edited[0], own.edited[1])
    with pytest.raises(InputError, match=r"inputs\.warps"):
        run(pair, editor, tmp_path, settings)
    small = warp_surfaces(
        views[0],
        views[0].resize(16, 16),
        Surface(FLAT.depth[:16, :16], FLAT.normal[:16, :16]),
        FLAT,
    )
    with pytest.raises(ValueError, match=r"warps\(0, 1\)\.mask: got shape \(16, 16\)"):
        run(pair, editor, settings=settings, warps=lambda source, target: small)


def test_of_warps_from_outside_one_is_held_at_a_time_while_they_are_hashed(scene, editor, tmp_path):
    """Oracles: references that do not hold their objects, hashlib."""
    views = scene[1]
    alive, most, made = weakref.WeakSet(), 0, {}

    def warps(source, target):
        nonlocal most
        most = max(most, len(alive))
        warp = warp_surfaces(views[source], views[target], FLAT, FLAT)
        alive.add(warp)
        made[target] = warp.correspondence.xy.numpy().copy(), warp.mask.numpy().copy()
        return warp

    result = run(scene, editor, tmp_path, replace(ONE, batch=1), warps=warps)
    assert most <= 1
    expected = hashlib.sha256()
    for part, shape in ((0, "float64(32, 32, 2)"), (1, "bool(32, 32)")):
        for view in plan(result).targets:
            expected.update(shape.encode() + made[view][part].tobytes())
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["inputs"]["warps"] == expected.hexdigest()


def test_without_a_mask_features_go_where_the_target_has_a_depth(scene, editor, tmp_path):
    views = scene[1]
    depth = np.full((32, 32), 2.0)
    depth[:, 8:] = np.nan
    part = Surface(depth, FLAT.normal)
    # The segment leaves no pixel, so by its mask the view would get no features.
    rules = attnwarp.warp.preset("corrected", segment=True)
    nothing = np.zeros((32, 32), bool)
    warp = warp_surfaces(views[0], views[0], part, part, rules, target_segment=nothing)
    settings = replace(ONE, mask=False, a0=1.0)
    result = run(scene, editor, tmp_path, settings, warps=lambda source, target: warp)
    assert result.counters["injected"] == 0.25
    for view in plan(result).targets:
        mask = read_image(tmp_path / "masks" / f"v{view}.png")
        assert (mask[:, :8] == 255).all() and (mask[:, 8:] == 0).all()


def test_a_splat_that_no_picture_shows_changes_no_edit(scene, editor):
    """Oracle: the edit of the scene without it."""
    model, views, images = scene
    # Twenty times as large: 0.1 is nearer than any picture shows, and beyond the renderer's 0.01.
    large = replace(model, means=20 * model.means, scales=20 * model.scales)
    poses = [camera.world_to_camera.copy() for camera in views]
    for pose in poses:
        pose[:3, 3] *= 20
    far = [Camera(c.K, p, 32, 32, c.name) for c, p in zip(views, poses, strict=True)]
    before = torch.tensor(np.array([c.position + 0.1 * c.rotation[2] for c in far])).float()
    floaters = replace(large.select(torch.arange(5)), means=before, scales=torch.full((5, 2), 0.02))
    parts = ("means", "quats", "scales", "opacities", "sh")
    joined = replace(
        large, **{p: torch.cat([getattr(large, p), getattr(floaters, p)]) for p in parts}
    )
    one, other = (run((splats, far, images), editor, settings=ONE) for splats in (large, joined))
    assert one.counters["injected"] == other.counters["injected"] > 0.5
    for view, picture in one.edited.items():
        assert np.array_equal(picture, other.edited[view])


def test_weight_zero_records_nothing_and_edits_each_view_as_the_editor_alone_does(
    finished, scene, editor, tmp_path
):
    result = run(scene, editor, tmp_path / "zero", replace(QUICK, a0=0.0))
    assert result.counters["feature_bytes"] == result.counters["injected"] == 0
    left = {path.parent.name for path in (tmp_path / "zero").rglob("*.png")}
    assert left.isdisjoint({"features", "masks"})
    full, _ = finished
    for views in ([plan(full).source], *plan(full).stages):  # a stage is one batch
        alone = edit(editor, [scene[2][k] for k in views], "a bear", steps=QUICK.steps).images
        for view, picture in zip(views, alone, strict=True):
            assert np.abs(result.edited[view] - 255 * picture).max() <= 0.5 + 1e-4  # 8 bits
    # Injection does change the views, or the test above would show nothing.
    assert all((full.edited[v] != result.edited[v]).any() for v in plan(full).stages[0])


def wall():
    """One disc so large that both cameras see it alone, in the plane z = 0."""
    color = Gaussians.sh_from_rgb(torch.tensor([[0.8, 0.4, 0.2]]))
    return replace(disc(50.0), sh=color)


def positions(source, target, h, w):
    """(h, w, 2) where the source sees what the target's (h, w) grid sees, on the plane z = 0."""
    grid, onto = target.resize(w, h), source.resize(w, h)
    rays = grid.directions() @ grid.rotation
    points = grid.position - rays * (grid.position[2] / rays[..., 2])[..., None]
    return onto.project(points)[0]


def blended(own, source, xy, a):
    """(h w, C) float64: bilinear, the border repeated, pixel by pixel."""
    h, w = xy.shape[:2]
    grid, result = source.reshape(h, w, -1), own.clone()
    for y in range(h):
        for x in range(w):
            u = min(max(xy[y, x, 0] - 0.5, 0.0), w - 1.0)
            v = min(max(xy[y, x, 1] - 0.5, 0.0), h - 1.0)
            left, top = int(u), int(v)
            right, below = min(left + 1, w - 1), min(top + 1, h - 1)
            du, dv = u - left, v - top
            warped = (1 - dv) * ((1 - du) * grid[top, left] + du * grid[top, right]) + dv * (
                (1 - du) * grid[below, left] + du * grid[below, right]
            )
            result[y * w + x] = a * warped + (1 - a) * own[y * w + x]
    return result


def test_one_step_is_the_written_out_injection_in_float64(editor, monkeypatch):
    from attnwarp.methods.algorithms import attention_warping as algorithm

    edits = []
    monkeypatch.setattr(algorithm, "edit", lambda *a, **k: edits.append(edit(*a, **k)) or edits[-1])
    model, views = wall(), cameras(2)
    random = np.random.default_rng(0)
    images = [random.random((32, 32, 3)).astype(np.float32) for _ in views]
    settings = replace(
        ONE, a0=0.7, mask=False, warp=attnwarp.warp.preset("corrected", normal_test="none"),
    )  # fmt: skip
    result = attention_warping(model, views, images, editor, "a bear", settings)

    exact = copy.copy(editor)
    exact.unet = copy.deepcopy(editor.unet).double()
    exact.vae = copy.deepcopy(editor.vae).double()
    timestep = editor.schedule.timesteps(1)[0]
    texts = editor.embed(["a bear", ""]).double()[[0, 1, 1]]
    noise = shared_noise((1, 4, 8, 8), 0).double()

    def one_pass(image, hook):
        pixels = torch.from_numpy(image.astype(np.float64)).permute(2, 0, 1)[None]
        before = exact.vae.encode(2 * pixels - 1).latent_dist.mode()
        x = torch.cat([torch.cat([noise] * 3), torch.cat([before, before, 0 * before])], dim=1)
        handles = [
            module.register_forward_hook(lambda m, args, out, name=name: hook(name, out))
            for name, module in exact.unet.named_modules()
            if name.startswith("up_blocks") and name.endswith((".attn1", ".attn2"))
        ]
        with torch.no_grad():
            out = exact.unet(x, torch.tensor(timestep), encoder_hidden_states=texts).sample
            for handle in handles:
                handle.remove()
            text, image_only, uncond = out
            e = uncond + 3.0 * (text - image_only) + 1.5 * (image_only - uncond)
            alpha = float(editor.schedule.alphas[timestep])
            x0 = (noise - (1 - alpha) ** 0.5 * e) / alpha**0.5
            last = editor.schedule.final_alpha
            latents = last**0.5 * x0 + (1 - last) ** 0.5 * e
            decoded = exact.vae.decode(latents / exact.vae.config.scaling_factor).sample[0]
        return latents, (decoded / 2 + 0.5).clamp(0, 1).permute(1, 2, 0).numpy()

    recorded = {}

    def keep(name, out):
        recorded[name] = out.clone()

    def inject(name, out):
        side = round(out.shape[1] ** 0.5)
        xy = positions(views[0], views[1], side, side)
        rows = [blended(out[k], recorded[name][k], xy, 0.7) for k in (0, 1)]
        return torch.stack([*rows, out[2]])

    expected = one_pass(images[0], keep), one_pass(images[1], inject)
    assert len(recorded) == 8
    for view, (latents, picture) in enumerate(expected):
        # float32 through a network whose attention is made loud.
        assert torch.allclose(edits[view].latents.double(), latents, rtol=0, atol=2e-4)
        assert np.abs(result.edited[view] / 255 - picture).max() < 0.5 / 255 + 1e-4
    alone, _ = one_pass(images[1], lambda name, out: None)
    assert (alone - expected[1][0]).abs().max() > 0.02  # 100 times the tolerance


def test_the_folder_holds_what_a_person_wants(finished, scene):
    result, folder = finished
    names = {Path(camera.name).stem for camera in scene[1]}
    edited = {Path(scene[1][view].name).stem for view in plan(result).edited}
    for part, expected in (
        ("views", edited), ("masks", edited - {"v0"}), ("renders/before", names), ("renders/after", names),
    ):  # fmt: skip
        assert {path.stem for path in (folder / part).glob("*.png")} == expected
    assert not (folder / ".recording").exists()
    last = read_ply(folder / "rounds" / "2.ply")
    assert torch.equal(read_ply(folder / "edited.ply").means, last.means)
    assert torch.allclose(result.gaussians.means, last.means, rtol=0, atol=1e-6)
    seconds = json.loads((folder / "times.json").read_text())
    assert set(seconds) == {"source", "warp", "edit", "write", "tune", "render"}
    assert all(value > 0 for value in seconds.values())


@pytest.mark.parametrize(
    "changes",
    [
        None,  # a source made by hand: inverted and replayed
        {"source_text_guidance": 1.5},  # s_T = s_I leaves no image branch
        {"source_text_guidance": 7.0, "text_guidance": 2.5, "guidance_drop": 1.0},
        IDEAS,
    ],
)
def test_network_rows_are_those_that_hooks_count(changes, scene, editor):
    settings = replace(ONE, stages=2, **(changes or {}))
    by_hand = scene[2][0] if changes is None else None
    rows, result = rows_of(
        editor.unet, lambda: run(scene, editor, settings=settings, source_picture=by_hand)
    )
    assert result.counters["network_rows"] == sum(rows)


def test_a_guidance_of_a_stage_that_does_not_come_hinders_nothing(scene, editor):
    """Five views leave two stages; s_T = s_I would come in the third."""
    settings = replace(
        QUICK, stages=3, steps=1, iterations=0, branches=("image",),
        text_guidance=4.5, guidance_drop=1.5,
    )  # fmt: skip
    assert run(scene, editor, settings=settings).counters["views"] == 5


def test_edit_psnr_counts_the_views_that_the_settings_name(finished, scene, editor):
    result, folder = finished
    errors = {}
    for view in plan(result).edited:
        name = Path(scene[1][view].name).stem
        picture = result.edited[view] / 255
        render = read_image(folder / "renders" / "after" / f"{name}.png") / 255
        errors[name] = np.square(picture - render).mean()
    assert result.edit_psnr["views"] == list(errors)
    pooled = -10 * np.log10(np.mean(list(errors.values())))
    each = -10 * np.log10(list(errors.values()))
    assert result.edit_psnr["pooled"] == pytest.approx(
        pooled, abs=0.05
    )  # renders rounded to 8 bits
    assert result.edit_psnr["mean"] == pytest.approx(np.mean(each), abs=0.05)
    released = run(scene, editor, settings=replace(ONE, stages=2, psnr_views="before_last_stage"))
    assert released.edit_psnr["views"] == list(errors)[:3]


def test_a_folder_of_another_format_is_refused(scene, editor, tmp_path):
    run(scene, editor, tmp_path, ONE)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**manifest, "format": 1}))
    with pytest.raises(InputError, match="holds an edit made by an older version; run it again"):
        run(scene, editor, tmp_path, ONE)


@pytest.mark.door
def test_a_view_that_renders_as_nan_is_no_picture(finished, scene, editor, monkeypatch):
    """The end of an edit that is complete but for what its folder says of the end."""
    render = attnwarp.methods.scene.render

    def broken(*args, **options):
        view = render(*args, **options)
        return replace(view, color=np.nan * view.color)

    monkeypatch.setattr(attnwarp.methods.scene, "render", broken)
    with pytest.raises(RuntimeError, match="view '.*' renders as NaN"):
        run(scene, editor, finished[1])


def test_a_recording_on_disk_gives_the_same_bytes_and_goes_away(finished, scene, editor, tmp_path):
    run(scene, editor, tmp_path, store="disk")
    assert files(tmp_path) == files(finished[1])
    assert not (tmp_path / ".recording").exists()


def test_a_recording_on_disk_that_a_kill_left_goes_away_in_the_next_sitting(
    scene, editor, tmp_path
):
    """Oracle: the files of the first sitting."""
    recorded = []
    for _ in range(2):
        with pytest.MonkeyPatch.context() as patch:
            watch, _ = events(patch, 7)
            with pytest.raises(Killed):
                run(scene, editor, tmp_path, store="disk", report=Watched(watch))
        paths = (tmp_path / ".recording").rglob("*")
        recorded.append(sorted(path.stat().st_size for path in paths if path.is_file()))
    assert recorded[0] == recorded[1] != []


def test_the_seconds_of_a_sitting_that_was_killed_are_counted_up_to_its_last_checkpoint(
    scene, editor, tmp_path, monkeypatch
):
    """Oracle: a clock on which each iteration takes one second, and all else none."""
    now, iterations = 0, 0

    def watch(done, total, text, left):
        nonlocal now, iterations
        if "loss" in text:
            now, iterations = now + 1, iterations + 1
        if iterations == 5:
            raise Killed

    monkeypatch.setattr(time, "perf_counter", lambda: now)
    settings = replace(QUICK, stages=1, iterations=6, perceptual=0.0)
    options = {"checkpoint_seconds": 0, "report": Watched(watch)}
    with pytest.raises(Killed):
        run(scene, editor, tmp_path, settings, **options)
    assert json.loads((tmp_path / "times.json").read_text())["tune"] == 4
    iterations = 10
    assert run(scene, editor, tmp_path, settings, **options).seconds["tune"] == 4 + 2


@pytest.mark.door
@pytest.mark.parametrize(
    ("settings", "words", "message"),
    [
        ({"steps": 3}, "a bear", r"settings\.steps \(2, now 3\)"),
        ({"warp": attnwarp.warp.preset("corrected", opaque=0.9)}, "a bear", r"settings\.warp\.opaque \(0\.5, now 0\.9\)"),
        ({}, "a robot", r'instruction \("a bear", now "a robot"\)'),
    ],
)  # fmt: skip
def test_a_folder_of_another_edit_is_refused_by_name(
    settings, words, message, finished, scene, editor
):
    before = files(finished[1])
    with pytest.raises(InputError, match=message):
        run(scene, editor, finished[1], replace(QUICK, **settings), words)
    assert files(finished[1]) == before


@pytest.mark.door
def test_a_folder_that_was_tuned_by_other_weights_is_refused(scene, editor, tmp_path):
    """One folder of LPIPS weights, with another network in it."""
    weights = tmp_path / "lpips"
    weights.mkdir()
    (weights / "alex.pth").write_bytes((tiny_models.linear_layers() / "alex.pth").read_bytes())
    settings = replace(QUICK, stages=1, perceptual_encoder=f"lpips:{weights}")
    refused = pytest.raises(InputError, match=r"holds an edit of other inputs\.perceptual")
    for seed, expected in ((0, nullcontext()), (0, nullcontext()), (1, refused)):
        tiny_models.save_backbone(weights / "alexnet-owt-7be5be79.pth", "alex", seed)
        with expected:
            run(scene, editor, tmp_path / "edit", settings)
    # A view too small for it is named before any is edited, if it is one to tune on.
    model, views, _ = scene
    edited = set(run(scene, editor, None, settings).edited)
    assert 0 in edited and len(edited) < len(views)
    tuned, other = max(edited), min(set(range(len(views))) - edited)
    named = f"views: '{views[tuned].name}' has 16 x 24 px, the perceptual distance lpips:.* needs"
    for small, expected in (
        (other, nullcontext()),
        (tuned, pytest.raises(ValueError, match=named)),
    ):
        cameras = [view.resize(16, 24) if k == small else view for k, view in enumerate(views)]
        with expected:
            attention_warping(model, cameras, None, editor, "a bear", settings)


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gaussians": "a.ply"}, "gaussians: got str, expected attnwarp.Gaussians"),
        ({"cameras": cameras()[0]}, "cameras: got Camera, expected a list of cameras"),
        ({"editor": "small"}, r"editor: got 'small', .*load_editor\('small'\)"),
        ({"source": "0"}, "source: got str, expected a number"),
    ],
)
def test_an_argument_of_another_type_is_named(scene, editor, changes, message):
    model, views, images = scene
    given = {"gaussians": model, "cameras": views, "images": images, "editor": editor}
    with pytest.raises(TypeError, match=message):
        attention_warping(**{**given, "instruction": "a bear", "settings": QUICK, **changes})


@pytest.mark.parametrize("part", further("masks"))
def test_pictures_of_where_features_went_are_drawn_again(part, finished, scene, editor, tmp_path):
    """Oracle: the bytes of the edit that nobody touched."""
    folder = shutil.copytree(finished[1], tmp_path / "folder")
    path = folder / part if part.endswith(".png") else next((folder / part).glob("*.png"))
    path.unlink()
    with pytest.warns(InputWarning, match=f"{path.name}: missing"):
        run(scene, editor, folder)
    assert files(folder) == files(finished[1])


def test_an_edit_made_again_for_a_picture_beside_it_has_to_be_the_same(
    finished, scene, editor, tmp_path
):
    """Other threads or another device give another edit: the tuned scene rests on the former
    edit.
    """
    folder = shutil.copytree(finished[1], tmp_path / "folder")
    other = np.zeros_like(read_image(folder / "rounds/1/v0.png"))
    view = plan(finished[0]).stages[1][0]
    (folder / f"masks/v{view}.png").unlink()
    path = folder / f"rounds/2/v{view}.png"
    path.write_bytes(encode_png(other))
    record = path.with_suffix(".json")
    sha256 = digest(other)
    record.write_text(json.dumps(json.loads(record.read_text()) | {"sha256": sha256}))
    for _ in range(2):  # the second sitting knows as much as the first
        with (
            pytest.warns(InputWarning, match="missing"),
            pytest.raises(InputError, match="edit is not the one that"),
        ):
            run(scene, editor, folder)
        assert np.array_equal(read_image(path), other)


@pytest.mark.parametrize("place", further("rounds/1/v0.png", "rounds/2/*.png"))
def test_the_same_picture_in_other_bytes_is_the_edit(place, finished, scene, editor, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "folder")
    path = next(folder.glob(place))
    Image.fromarray(read_image(path)).save(path, compress_level=0)
    before = files(folder)
    assert before != files(finished[1])
    run(scene, editor, folder)  # warnings are errors
    assert files(folder) == before


@pytest.mark.parametrize("place", further("rounds/1/v0.png", "rounds/2/*.png"))
def test_another_picture_in_place_of_an_edit_is_not_taken_for_it(
    place, finished, scene, editor, tmp_path
):
    """Oracle: the bytes of the edit that nobody touched."""
    folder = shutil.copytree(finished[1], tmp_path / "folder")
    path = next(folder.glob(place))
    path.write_bytes(encode_png(255 - read_image(path)))
    with pytest.warns(InputWarning, match=f"{path.name}: not the picture that the edit made"):
        run(scene, editor, folder)
    assert files(folder) == files(finished[1])


@pytest.mark.parametrize(
    "name", further("masks/v0.png", "edited.ply", "segments/x.png", "views/x.json")
)
def test_a_persons_files_where_results_go_are_left_alone(name, scene, editor, tmp_path):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"mine")
    with pytest.raises(InputError, match=r"has no manifest\.json"):
        run(scene, editor, tmp_path)
    assert path.read_bytes() == b"mine"


@pytest.mark.door
def test_a_folder_of_another_scene_is_refused_by_name(finished, scene, editor):
    model, views, images = scene
    with pytest.raises(InputError, match=r"inputs\.images"):
        run((model, views, [1 - image for image in images]), editor, finished[1])
    moved = replace(model, means=model.means + 0.01)
    with pytest.raises(InputError, match=r"inputs\.splats"):
        run((moved, views, images), editor, finished[1])


def test_segments_leave_the_original_or_black_outside(scene, editor):
    images = scene[2]
    left = np.zeros((32, 32), dtype=bool)
    left[:, :16] = True
    whole = run(scene, editor, settings=ONE)
    kept = run(scene, editor, settings=ONE, segments=lambda view, picture: left)
    black = run(scene, editor, settings=replace(ONE, composite="black"), segments=[left] * 5)
    for view in plan(whole).edited:
        assert np.array_equal(kept.edited[view][:, :16], whole.edited[view][:, :16])
        assert np.array_equal(kept.edited[view][:, 16:], to_bytes(images[view])[:, 16:])
        assert (black.edited[view][:, 16:] == 0).all()
    with pytest.raises(ValueError, match=r"segments\[0\] \(v0.png\): got int64, expected bool"):
        run(scene, editor, settings=ONE, segments=[left * 1] * 5)
    with pytest.raises(ValueError, match="segments: every one is empty"):
        run(scene, editor, settings=ONE, segments=[left & False] * 5)


@pytest.mark.parametrize("how", further("black", "original"))
def test_splats_are_tuned_on_pictures_that_a_small_edit_changes_in_the_segments_alone(
    how, scene, editor, monkeypatch
):
    tuned, advance = {}, Tuning.advance

    def watched(tuning, begin, end, views, numbers, *more, **options):
        tuned.update(zip(numbers, views.images, strict=True))
        advance(tuning, begin, end, views, numbers, *more, **options)

    monkeypatch.setattr(Tuning, "advance", watched)
    left = np.zeros((32, 32), dtype=bool)
    left[:, :15] = True  # ends within a pixel of the edit
    settings = replace(ONE, size=16, composite=how)
    result = run(scene, editor, settings=settings, segments=[left] * 5)
    assert tuned.keys() == {*plan(result).edited}
    for view, picture in tuned.items():
        before = scene[2][view]
        outside = before if how == "original" else 0 * before
        assert np.array_equal(picture[:, 15:], outside[:, 15:])
        assert np.abs(picture - before)[:, :15].max() > 0.1


def test_a_picture_edited_by_hand_is_the_source_in_any_type_that_images_have(
    finished, scene, editor
):
    """Oracle: a depth of 16 bits holds a depth of 8 bits exactly, as 257 of its steps."""
    picture = np.random.default_rng(1).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    settings = replace(QUICK, iterations=0, stages=1)
    deep = picture.astype(np.uint16) * np.uint16(257)
    one, other = (run(scene, editor, settings=settings, source_picture=p) for p in (picture, deep))
    assert np.array_equal(one.edited[0], picture)
    for view, pixels in one.edited.items():
        assert np.array_equal(pixels, other.edited[view])
        assert not np.array_equal(pixels, finished[0].edited[view])
    with pytest.raises(ValueError, match="source_picture: got int64, expected uint8, uint16 or"):
        run(scene, editor, settings=settings, source_picture=picture.astype(np.int64))


def test_where_the_source_is_the_only_view_the_splats_are_tuned_on_it(scene, editor, tmp_path):
    model, cameras, images = scene
    part = model, cameras[:1], images[:1]
    lines = []
    result = run(part, editor, tmp_path, replace(QUICK, steps=1), report=Watched(log=lines.append))
    assert list(result.edited) == [0]
    tuned = json.loads((tmp_path / "result.json").read_text())["tuned"]
    assert tuned == {"v0": 3}
    assert result.counters["iterations"] == 3
    assert not torch.equal(result.gaussians.sh, model.sh)
    (line,) = [line for line in lines if line.startswith("stages")]
    assert line.startswith("stages: 1 that tunes on the source alone in place of 2, as ")


@pytest.mark.parametrize("width", [32, 48])
def test_it_says_whose_noise_cannot_stick_to_the_surface(width, scene, editor):
    """Oracle: latents of one size hold equally many noise values."""
    model, cameras, images = scene
    other = Camera(cameras[1].K, cameras[1].world_to_camera, width, 32, "wide.png")
    part = model, [cameras[0], other], [images[0], np.zeros((32, width, 3), np.float32)]
    lines = []
    settings = replace(ONE, noise="surface", size=None)
    run(part, editor, settings=settings, report=Watched(log=lines.append))
    said = [line for line in lines if line.startswith("noise: that of 1 of 2 views does not stick")]
    assert len(said) == (width != 32) and all("first: wide" in line for line in said)


def noise(settings, views):
    from attnwarp.methods.carried import initial_noise

    return initial_noise(settings, views, (4, 16, 16), (16, 16), [None] * len(views))


def test_fresh_noise_is_each_views_own_and_shared_noise_is_one():
    shared = noise(QUICK, [1, 2])
    assert torch.equal(shared[0], shared[1])
    fresh = replace(QUICK, noise="fresh")
    first = noise(fresh, [1, 2])
    assert not torch.equal(first[0], first[1])
    # A view's noise does not depend on who is edited beside it.
    assert torch.equal(first[1], noise(fresh, [2])[0])


def test_no_two_seeds_and_views_have_the_same_fresh_noise_nor_the_shared_one_of_any():
    draws = []
    for seed in range(3):
        fresh = noise(replace(QUICK, noise="fresh", seed=seed), range(8))
        draws.extend(one.numpy().tobytes() for one in fresh)
    draws.extend(shared_noise((1, 4, 16, 16), seed).numpy().tobytes() for seed in range(16))
    assert len(set(draws)) == 3 * 8 + 16


def test_the_released_start_is_one_timestep_in_the_range(scene, editor):
    from attnwarp.methods.algorithms.attention_warping import check_editor

    drawn = {
        check_editor(editor, replace(QUICK, start=(700, 980), seed=seed)) for seed in range(50)
    }
    assert min(drawn) >= 700
    assert max(drawn) <= 980
    assert len(drawn) > 30
    result = run(scene, editor, settings=replace(ONE, steps=2, start=(700, 700)))
    noised = edit(editor, [scene[2][0]], "a bear", steps=2, seed=0, start=700).images[0]
    assert np.array_equal(result.edited[0], to_bytes(noised))


def test_the_released_start_is_a_share_of_signal(scene, editor, monkeypatch):
    # At every step twice the signal that Stable Diffusion has for the same noise.
    alphas = 4 * editor.schedule.alphas / (1 + 3 * editor.schedule.alphas)
    monkeypatch.setattr(editor, "schedule", DDIM(alphas, "epsilon", 1.0))
    steps = []
    handle = editor.unet.register_forward_pre_hook(lambda module, args: steps.append(int(args[1])))
    settings = replace(ONE, views_per_stage=1, steps=4, start=(700, 700))
    by_hand = scene[2][0][::-1].copy()
    try:
        run(scene, editor, settings=settings)
        # An edit made by hand is inverted along the same steps.
        run(scene, editor, settings=settings, source_picture=by_hand)
    finally:
        handle.remove()
    assert set(steps) == set(nearest_steps(alphas, [700, 525, 349, 174]))


def test_depth_of_the_frozen_model_does_not_follow_the_tuning(scene, editor, tmp_path, monkeypatch):
    fast = functools.partial(FitSettings, lr_means=0.03, lr_means_final=0.03, lr_scales=1.0)
    monkeypatch.setattr(tuning, "FitSettings", fast)
    rough = replace(QUICK, kinds=("self",), steps=1, views_per_stage=1)
    still = run(scene, editor, tmp_path / "still", replace(rough, iterations=0))
    last = [Path(scene[1][view].name).stem for view in plan(still).stages[1]]

    def pictures_of(name):
        return [(tmp_path / name / "views" / f"{view}.png").read_bytes() for view in last]

    run(scene, editor, tmp_path / "frozen", rough)
    run(scene, editor, tmp_path / "current", replace(rough, depth_from="current"))
    assert pictures_of("frozen") == pictures_of("still")
    assert pictures_of("current") != pictures_of("still")


def test_views_are_edited_at_the_editors_size_and_their_change_enlarged(scene, editor, tmp_path):
    model, views = splats(), cameras(size=64)
    images = pictures(model, views)
    settings = replace(ONE, size=32)
    result = attention_warping(model, views, images, editor, "a bear", settings, folder=tmp_path)
    assert {picture.shape for picture in result.edited.values()} == {(32, 32, 3)}
    assert read_image(tmp_path / "masks" / "v1.png").shape == (64, 64, 3)


@pytest.mark.door
def test_arguments_that_do_not_fit_are_named(scene, editor):
    model, views, images = scene
    with pytest.raises(ValueError, match="images: got 4, expected 5"):
        attention_warping(model, views, images[:4], editor, "a bear", QUICK)
    with pytest.raises(ValueError, match="source: got 5"):
        attention_warping(model, views, images, editor, "a bear", QUICK, source=5)
    with pytest.raises(ValueError, match="instruction: is empty"):
        attention_warping(model, views, images, editor, "  ", QUICK)
    with pytest.raises(ValueError, match="checkpoint_seconds: got None"):
        run((model, views, images), editor, checkpoint_seconds=None)
    inverted = replace(QUICK, latents="inversion")
    with pytest.raises(ValueError, match="source_picture: got one with latents 'inversion', but"):
        run((model, views, images), editor, settings=inverted, source_picture=images[0])


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"perceptual_encoder": "bogus"}, "encoder 'bogus': unknown"),
        ({"latents": "inversion"}, "latents: 'inversion' is made for a depth .*InstructPix2Pix"),
        ({"branches": ("bogus",)}, "branches: got 'bogus', expected one of 'text', 'image', "),
        (
            {"branches": ("image",), "source_text_guidance": 1.5},  # s_T = s_I
            "branches: got 'image', expected one of 'text', 'uncond', .* at text guidance 1.5",
        ),
        (
            {"branches": ("image",), "source_text_guidance": 7.0, "text_guidance": 1.5},
            "branches: image would be .* text guidance 1.5 stage 1 has text, uncond; choose",
        ),
        (
            {"branches": ("image",), "text_guidance": 3.0, "guidance_drop": 1.5},
            "branches: image would be .* text guidance 1.5 stage 2 has text, uncond; choose",
        ),
        (
            {"unseen": "attend", "source_text_guidance": 1.5},  # s_T = s_I
            "unseen: .* source, which has text, uncond .* stage 1 has text, image, uncond; set",
        ),
        (
            # As many branches each, of which one differs.
            {
                "unseen": "attend",
                "image_guidance": 0.0,
                "source_text_guidance": 0.0,
                "text_guidance": 1.0,
            },
            "unseen: .* at text guidance 0, but at text guidance 1 stage 1 has",
        ),
    ],
)
def test_settings_that_an_edit_cannot_have_are_refused_before_any_work(
    changes, message, scene, editor, tmp_path
):
    def refused():
        with pytest.raises(ValueError, match=message):
            run(scene, editor, tmp_path, replace(QUICK, **changes), segments=everything)

    everything = [np.ones((32, 32), bool)] * 5
    rows, _ = rows_of(editor.unet, refused)
    assert not rows
    assert not any(tmp_path.iterdir())  # a manifest would hold the folder to the wrong setting


def guidance_of_passes(editor, name, call):
    """The text guidance that each pass of the UNet has, without repetitions; and the result."""
    values = []

    def note(*_):
        value = getattr(editor, name)
        if not values or values[-1] != value:
            values.append(value)

    handle = editor.unet.register_forward_pre_hook(note)
    try:
        return values, call()
    finally:
        handle.remove()


def quick(name, **more):
    return preset(
        "attention_warping",
        name,
        **{"stages": 2, "views_per_stage": 2, "steps": 2, "iterations": 12, **more},
    )


def test_released_guidance_falls_by_stage_and_the_editors_own_comes_back(scene, editor):
    values, _ = guidance_of_passes(
        editor,
        "text_guidance",
        lambda: run(scene, editor, settings=quick("released", steps=1, iterations=0)),
    )
    assert values == [12.5, 11.0]  # source and first stage, second stage
    assert editor.text_guidance == 3.0
    values, _ = guidance_of_passes(
        editor,
        "text_guidance",
        lambda: run(scene, editor, settings=quick("corrected", steps=1, iterations=0)),
    )
    assert values == [3.0]


@pytest.fixture
def depth_editor():
    """A ControlNet whose own guidance, which has one branch, runs in no pass of an edit."""
    from tiny_editors import controlnet

    from attnwarp.editing.editors.controlnet import DepthControlNet

    pipe = controlnet(halvings=2)
    names = ("unet", "vae", "text_encoder", "tokenizer", "scheduler", "controlnet")
    return DepthControlNet(*(getattr(pipe, name) for name in names), text_guidance=1.0)


SHORT = {"suffix": ", good", "negative_prompt": "blur"}
"""Words that the tiny text encoder has room for, in place of Stable Diffusion's."""


def test_a_controlnet_is_guided_by_depth_with_both_branches_and_its_released_guidance(
    scene, depth_editor, tmp_path
):
    settings = quick("released-controlnet", iterations=0, **SHORT)
    values, result = guidance_of_passes(
        depth_editor, "text_guidance", lambda: run(scene, depth_editor, tmp_path, settings)
    )
    assert values == [7.5, 12.5, 1.0, 12.5]  # the second stage inverts its views unguided
    source = record(tmp_path, "v0")
    assert result.counters["network_rows"] == 5 * 2 * 2 + 2 * 2
    # 4 layers of 16 channels at 8 x 8 and 4 of 32 at 4 x 4, two branches, two steps, float32.
    assert source["feature_bytes"] == (4 * 64 * 16 + 4 * 16 * 32) * 2 * 2 * 4
    assert len(result.edited) == 5


def test_latents_by_stage_are_random_first_and_the_renders_own_later(
    scene, depth_editor, monkeypatch
):
    from attnwarp.methods.algorithms import attention_warping as algorithm

    model, views, _ = scene
    inverted, prompts = [], []
    invert, task = algorithm.invert_view, depth_editor.task

    def noted(editor, guide, picture, prompt, **more):
        inverted.append(picture)
        return invert(editor, guide, picture, prompt, **more)

    monkeypatch.setattr(algorithm, "invert_view", noted)
    monkeypatch.setattr(
        depth_editor,
        "task",
        lambda g, words, regions=None: (
            prompts.append((words, depth_editor.negative_prompt)) or task(g, words)
        ),
    )
    settings = quick(
        "released-controlnet", color_rate=40.0, views_per_stage=1, iterations=4, **SHORT
    )
    result = run(scene, depth_editor, None, settings)
    # A view a stage: the source and stage 1 from noise, stage 2 from a render of the tuned scene.
    assert len(inverted) == 1
    first, second = (result.rounds[k].views for k in (0, 1))
    assert len(first) == 2 and len(second) == 1
    for picture, view in zip(inverted, second, strict=True):
        before = pictures(model, [views[view]])[0]
        assert np.abs(picture - before).max() > 0.02  # tuning moved it
        assert np.abs(picture - before).mean() < 0.2
    edits = [(words, negative) for words, negative in prompts if words]
    assert set(edits) == {("a bear, good", "blur")}
    assert depth_editor.negative_prompt == ""


def test_an_editor_without_a_negative_prompt_is_refused_one(scene, editor):
    with pytest.raises(ValueError, match="negative_prompt: this editor has none; leave it out"):
        run(scene, editor, settings=replace(QUICK, negative_prompt="blur"))


def test_the_released_start_noises_the_original_first_and_the_render_later(
    scene, editor, monkeypatch
):
    from attnwarp.methods.algorithms import attention_warping as algorithm

    model, views, images = scene
    noised = []
    one = algorithm.edit
    monkeypatch.setattr(
        algorithm, "edit", lambda *a, **k: noised.extend(k["pictures"]) or one(*a, **k)
    )
    settings = quick("released", color_rate=40.0, steps=1, iterations=4)
    result = run(scene, editor, settings=settings)
    first, second = (result.rounds[k].views for k in (0, 1))
    assert all(np.array_equal(p, images[v]) for p, v in zip(noised, first, strict=False))
    for picture, view in zip(noised[len(first) :], second, strict=True):
        assert not np.array_equal(picture, images[view])
        assert np.abs(picture - pictures(model, [views[view]])[0]).max() > 0.02


def inverted_by_diffusers(net, depth, picture, prompt, steps):
    """(1, C, h, w) at the noisiest step, by diffusers' own inverse scheduler and models."""
    from diffusers import DDIMInverseScheduler

    from attnwarp.editing.editors.controlnet import control_image

    inverse = DDIMInverseScheduler.from_config(net.scheduler.config)
    inverse.set_timesteps(steps)
    with torch.no_grad():
        text = net.embed([prompt])
        control = torch.from_numpy(control_image(depth)).permute(2, 0, 1)[None]
        pixels = torch.from_numpy(picture).permute(2, 0, 1)[None]
        x = net.vae.encode(2 * pixels - 1).latent_dist.mode() * net.vae.config.scaling_factor
        for t in inverse.timesteps:
            down, middle = net.controlnet(x, t, text, control, return_dict=False)
            noise = net.unet(
                x, t, text,
                down_block_additional_residuals=down, mid_block_additional_residual=middle,
            ).sample  # fmt: skip
            x = inverse.step(noise, int(t), x).prev_sample
    return x


def test_inverted_latents_are_those_of_diffusers_with_the_source_prompt(
    scene, depth_editor, monkeypatch
):
    guides, task = [], depth_editor.task
    monkeypatch.setattr(
        depth_editor,
        "task",
        lambda g, words, regions=None: guides.append((words, g)) or task(g, words),
    )
    settings = quick(
        "corrected", a0=0.0, text_guidance=3.0, iterations=0,
        latents="inversion", source_prompt="a bear", stages=1, views_per_stage=1,
    )  # fmt: skip
    rows, result = rows_of(
        depth_editor.unet, lambda: run(scene, depth_editor, None, settings, "a red bear")
    )
    assert result.counters["network_rows"] == sum(rows)
    assert rows.count(1) == 2 * 2 and depth_editor.text_guidance == 1.0  # inverted unguided
    assert [words for words, _ in guides].count("a bear") == 2
    _, first = guides[0]
    monkeypatch.setattr(depth_editor, "text_guidance", 3.0)
    x = inverted_by_diffusers(depth_editor, first[0], scene[2][0], "a bear", 2)
    expected = edit(depth_editor, first, "a red bear", steps=2, latents=x).images[0]
    assert np.abs(result.edited[0] - 255 * expected).max() < 1
    # It is no noise that views share, nor what an edit without inversion gives.
    alone = run(scene, depth_editor, None, replace(settings, latents="random", source_prompt=""))
    assert np.abs(result.edited[0].astype(int) - alone.edited[0]).max() > 8


def test_features_are_carried_between_inverted_views(scene, depth_editor, tmp_path):
    """A view at the source's place, of the same picture, gets the source's edit."""
    model, views, images = scene
    twins = model, [views[0], views[0], views[2]], [images[0], images[0], images[2]]
    settings = quick(
        "corrected", stages=1, iterations=0, latents="inversion", a0=1.0, decay="constant"
    )
    result = run(twins, depth_editor, tmp_path / "whole", settings)
    assert np.abs(result.edited[0].astype(int) - result.edited[1]).max() <= 1
    other = run(twins, depth_editor, tmp_path / "alone", replace(settings, a0=0.0))
    assert not np.array_equal(other.edited[2], result.edited[2])


def visits(folder):
    return set(json.loads((folder / "result.json").read_text())["tuned"])


def test_a_stage_tunes_on_the_views_that_the_settings_name(scene, editor, tmp_path):
    for choice in ("all", "stage"):
        settings = quick("corrected", training=choice, stages=1, steps=1)
        run(scene, editor, tmp_path / choice, settings)
    drawn = {path.stem for path in (tmp_path / "all" / "views").glob("*.png")}
    assert visits(tmp_path / "stage") == drawn - {"v0"}
    assert visits(tmp_path / "all") == drawn


def test_progress_ends_at_its_total_and_never_falls(finished):
    # Five views of two steps, two stages of three iterations.
    assert {step[1] for step in PROGRESS} == {5 * 2 + 2 * 3}
    done = [step[0] for step in PROGRESS]
    assert done == sorted(done)
    # The last is the word that all is done.
    assert done[-2] == done[-1] == 16
    assert PROGRESS[-1][2] == "done"


def test_each_kind_of_attention_is_carried_by_a_course_of_its_own(scene, editor):
    """Oracle: a loop that blends each layer's output itself, at the source's place."""
    settings = replace(ONE, steps=4, a0=0.8, decay="by_kind", batch=1)
    model, views, images = scene
    twin = Camera(views[0].K, views[0].world_to_camera, 32, 32, "twin")
    identity = warp_surfaces(views[0], views[0], FLAT, FLAT)
    pair = model, [views[0], twin], [images[0], images[1]]
    result = run(pair, editor, settings=settings, warps=lambda source, target: identity)
    kept = {}
    branches = [k for k, name in enumerate(editor.branches) if name in editor.carries]

    def edited(image, change):
        calls = dict.fromkeys((layer.name for layer in editor.layers()), 0)

        def hook(name, module, args, out):
            step, calls[name] = calls[name], calls[name] + 1
            return change(name, step, out)

        handles = [
            editor.unet.get_submodule(name).register_forward_hook(functools.partial(hook, name))
            for name in calls
        ]
        picture = edit(editor, [image], "a bear", steps=4).images[0]
        for handle in handles:
            handle.remove()
        return picture

    def keep(name, step, out):
        kept[name, step] = out.clone()

    def carry(name, step, out):
        weight = 0.8 if name.endswith("attn1") else (0.8, 0.2, 0, 0)[step]
        out = out.clone()
        for row in branches:
            out[row] = (1 - weight) * out[row] + weight * kept[name, step][row]
        return out

    edited(images[0], keep)
    expected = edited(images[1], carry)
    assert np.abs(result.edited[1] / 255 - expected).max() < 0.5 / 255 + 1e-4


def test_an_edit_with_features_of_chosen_steps_is_written_and_resumed(
    finished, scene, editor, tmp_path
):
    """Oracles: half of the bytes, and the same pictures from what is kept."""
    settings = replace(QUICK, stages=1, iterations=0, feature_steps=(0.0, 0.5))
    first = run(scene, editor, tmp_path, settings)
    some, everything = (record(folder, "v0")["feature_bytes"] for folder in (tmp_path, finished[1]))
    assert 2 * some == everything
    again = run(scene, editor, tmp_path, settings)
    for view, picture in first.edited.items():
        assert (again.edited[view] == picture).all()


def test_noise_of_the_surface_changes_the_views(finished, scene, editor):
    # The first stage's views are edited before any tuning, so tuning is no part of the difference.
    settings = replace(QUICK, stages=1, iterations=0, noise="surface")
    result = run(scene, editor, settings=settings)
    first = plan(finished[0]).stages[0]
    assert plan(result).stages == [first]
    assert any((result.edited[k] != finished[0].edited[k]).any() for k in first)


@pytest.fixture(scope="module")
def extended(scene, editor, tmp_path_factory):
    folder = tmp_path_factory.mktemp("extended")
    return run(scene, editor, folder, replace(QUICK, **IDEAS)), folder


@pytest.mark.parametrize("store", further("cpu", "disk"))
def test_the_memory_of_the_recording_is_told_once_before_it(store, scene, editor, tmp_path):
    """Oracle: features counted by hand."""
    told = []
    settings = replace(ONE, steps=2, views_per_stage=1, size=None)
    result = run(scene, editor, tmp_path, settings, store=store,
        report=Watched(lambda *_: told.append("work"), told.append))  # fmt: skip
    (line,) = [text for text in told if text.startswith("recording")]
    assert "work" not in told[: told.index(line)]
    # 4 layers of 16 channels at 8 x 8 and 4 of 32 at 4 x 4, two branches, two steps, float32.
    one = (4 * 64 * 16 + 4 * 16 * 32) * 2 * 2 * 4
    place = tmp_path / ".recording" if store == "disk" else "main memory"
    assert line == (
        f"recording 8 layers, 2 branches (text, image), 2 steps in float32:"
        f" {one / 2**20:.1f} MiB in {place}"
    )
    assert result.counters["feature_bytes"] == one


@pytest.mark.door
def test_a_source_prompt_that_is_too_long_is_refused_before_any_work(
    scene, depth_editor, monkeypatch
):
    settings = quick("corrected", latents="inversion", source_prompt="a bear " * 40)
    for work in ("task", "raw_latents", "embed"):
        monkeypatch.setattr(depth_editor, work, lambda *_: pytest.fail("work was done"))
    with pytest.raises(ValueError, match="tokens, the text encoder takes .*; shorten it"):
        run(scene, depth_editor, None, settings)


def test_views_edited_side_by_side_have_the_bits_of_views_edited_in_turn(scene, editor):
    settings = replace(QUICK, **IDEAS, unseen="attend", stages=1, iterations=0)
    more = {"segments": [np.ones((32, 32), bool)] * len(scene[1])}
    in_turn = run(scene, editor, settings=replace(settings, batch=1), **more)
    steps = []

    def spread(*step):
        steps.append(step)
        if len(steps) == settings.steps:  # the source, which both edit in one thread, is edited
            torch.set_num_threads(2)

    beside = run(scene, editor, settings=replace(settings, batch=2), report=Watched(spread), **more)
    assert torch.get_num_threads() == 2
    torch.set_num_threads(1)
    assert len(in_turn.edited) == 3
    for one, other in zip(in_turn.edited.values(), beside.edited.values(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_with_every_idea_a_killed_run_gives_the_same_bytes(extended, scene, editor, tmp_path):
    settings = replace(QUICK, **IDEAS)
    moment = int(np.random.default_rng(0).integers(5, 60))
    with pytest.MonkeyPatch.context() as patch:
        watch, _ = events(patch, moment)
        with pytest.raises(Killed):
            run(scene, editor, tmp_path, settings, report=Watched(watch), checkpoint_seconds=0)
    run(scene, editor, tmp_path, settings)
    assert files(tmp_path) == files(extended[1])
