"""Oracles: every picture of all answers by Bayes' rule in float64, the editor's own loop on the same noise, a loop
that records, warps and blends by hand, binomial counts."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch_threads import on_one_thread

import attnwarp.warp
from attnwarp.editing.editor import edit
from attnwarp.methods import attention_warping, preset
from attnwarp.render import render
from attnwarp_eval.scene.edits import apply
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.shared.controls import MovedView
from attnwarp_eval.study.shared.warps import warp_truth
from attnwarp_eval.two_view import HIDDEN
from attnwarp_eval.world import splats, world
from attnwarp_lab.ideal.editor import Answers, IdealEditor, schedule, tokens_of
from attnwarp_lab.ideal.figures import part_answers, part_figures
from attnwarp_lab.ideal.paint import painted
from attnwarp_lab.ideal.parts import part_labels, token_parts
from attnwarp_lab.ideal.share import Alone, Grams, alone, edit_alone, settling_steps, solve_share
from attnwarp_lab.ideal.thing import Thing

SPHERES = ["melon", "marble", "beach_ball", "planet", "stone", "bubble"]
VIEWS = ["source", "yaw010", "yaw030"]
PARTS = 12

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def view(parts, answers=3, seed=0):
    """A view of 12 x 12 px, 3 x 3 tokens."""
    random = np.random.default_rng(seed)
    before = random.random((12, 12, 3)).astype(np.float32)
    after = random.random((answers, 12, 12, 3)).astype(np.float32)
    return Answers(before, after, np.array(parts).reshape(3, 3))


@pytest.mark.parametrize("parts", [[0, 0, -1, 0, 0, -1, 0, 0, 0], [0, 1, -1, 1, 0, 1, 1, 0, 0]])
@pytest.mark.parametrize("cross", ["paint", "word", "swapped"])
def test_the_prediction_is_the_posterior_mean_over_all_pictures(parts, cross):
    own, share, timestep = view(parts), 0.02, 640
    editor = IdealEditor([own], share, cross)
    editor.unet.double()
    generator = torch.Generator().manual_seed(1)
    a = float(editor.schedule.alphas[timestep])
    before, after = (
        tokens_of(torch.from_numpy(p).permute(2, 0, 1)[None]).double()
        for p in (own.before, own.after[1])
    )
    x = a**0.5 * after + (1 - a) ** 0.5 * torch.randn(
        before.shape, generator=generator, dtype=torch.float64
    )

    count, mean, total, weights = max(parts) + 1, torch.zeros_like(x), 0.0, []
    for answers in itertools.product(range(3), repeat=count):
        picture = before.clone()
        for token, part in enumerate(parts):
            if part >= 0:
                full = tokens_of(
                    torch.from_numpy(own.after[answers[part]]).permute(2, 0, 1)[None]
                ).double()
                picture[token] = full[token]
        density = math.exp(-float((x - a**0.5 * picture).square().sum()) / (2 * (1 - a)) + 200)
        mean, total = mean + density * picture, total + density
        weights.append(density)
    assert max(weights) / total < 0.95  # several pictures are in question, so the mean is no copy

    sample = x.T.reshape(1, -1, 3, 3)
    predicted = editor.unet(sample, timestep, views=[0])[0].flatten(1).T
    assert (predicted - mean / total).abs().max() < 1e-6


def test_the_schedule_ends_in_noise_alone_and_a_share_scales_its_signal():
    whole, part = schedule().alphas.double(), schedule(0.25).alphas.double()
    assert float(whole[-1]) == 0 and float(whole[0]) == pytest.approx(1 - 0.00085, abs=1e-6)
    ratio = (part / (1 - part)) / (whole / (1 - whole))
    assert torch.allclose(ratio[:-1], torch.full_like(ratio[:-1], 0.25), rtol=1e-3, atol=0)


def test_edits_alone_by_their_gram_matrices_are_those_of_the_editor():
    views, share, steps = [view([0, 0, 1, 0, 1, 1, -1, 0, 1], seed=s) for s in (0, 1)], 0.05, 6
    editor, grams = IdealEditor(views, share), Grams.of(views)
    noise = torch.randn((2, 48, 3, 3), generator=torch.Generator().manual_seed(3))
    result = edit(editor, [one.before for one in views], "paint", steps=steps, noise=noise)
    net, tokens = editor.unet, noise.flatten(2).transpose(1, 2)
    starts = []
    for number, part in zip(grams.view, grams.part, strict=True):
        own = net.parts[number] == int(part)
        starts.append(torch.einsum("nc,knc->k", tokens[number, own], net.change[number][:, own]))
    weights = edit_alone(grams, torch.stack(starts)[:, None], share, steps)[-1, :, 0]
    for row, number, part in zip(weights, grams.view, grams.part, strict=True):
        own = net.parts[number] == int(part)
        change = result.latents[number].flatten(1).T[own] - net.before[number][own]
        expected = torch.einsum("k,knc->nc", row.float(), net.change[number][:, own])
        assert (change - expected).abs().max() < 1e-4


def test_a_picture_of_no_view_is_refused():
    editor = IdealEditor([view([0] * 9)])
    with pytest.raises(ValueError, match="guides: got a picture that is no view's"):
        editor.task([np.zeros((12, 12, 3), np.float32)], "paint")


def test_parts_are_the_same_surface_in_every_view():
    random = np.random.default_rng(0)
    points = random.random((6, 8, 3))
    points[0] = np.nan
    labels = part_labels({"a": points, "b": points[:, ::-1]}, 4)
    assert (labels["a"][:, ::-1] == labels["b"]).all() and (labels["a"][0] == -1).all()
    centers = [points[labels["a"] == k].mean(axis=0) for k in range(4)]
    nearest = np.linalg.norm(points[1:, :, None] - np.array(centers), axis=-1).argmin(axis=-1)
    assert (nearest == labels["a"][1:]).mean() > 0.95  # the cells of k-means, at its tolerance


def test_a_token_has_the_part_of_most_of_its_pixels():
    random = np.random.default_rng(0)
    labels = random.integers(-1, 3, (12, 8)).astype(np.int16)
    tokens = token_parts(labels, (3, 2))
    for row in range(3):
        for column in range(2):
            values, counts = np.unique(
                labels[4 * row : 4 * row + 4, 4 * column : 4 * column + 4], return_counts=True
            )
            assert tokens[row, column] in values[counts == counts.max()]


def test_settling_is_the_last_change_of_mind():
    weights = torch.tensor([[0.9, 0.1], [0.2, 0.8], [0.4, 0.6], [0.1, 0.9]])
    assert settling_steps(weights[:, None, None]).item() == 1


def test_an_editor_that_collapses_is_not_ideal():
    assert Alone(0.1, (0.97, 0.01, 0.01, 0.01), 0.94).fault() is not None
    assert Alone(0.1, (0.25, 0.25, 0.25, 0.25), 0.4).fault() is not None
    assert Alone(0.4, (0.22, 0.29, 0.22, 0.27), 0.26).fault() is None


@pytest.fixture(scope="module")
def thing(coarse_textures):
    of = world("spheres", 64)
    cameras = [of.camera(name) for name in VIEWS]
    return Thing.of(of.scene, of.geometry, cameras, SPHERES, parts=PARTS, colors=4, spp=1)


@pytest.fixture(scope="module")
def share(thing):
    return solve_share(thing.grams, 0.4, 8)


def model():
    return splats("spheres", 64, 0, kind="2d", count=500, position_noise=0.0, normal_noise=0.0)


def exact(source, target):
    of = world("spheres", 64)
    settings = attnwarp.warp.preset("corrected", depth_relative=1e-4, depth_spread=0.02)
    return warp_truth(of, of.between(VIEWS[source], VIEWS[target]), settings)


def test_alone_with_fresh_noise_answers_are_uniform_and_agree_by_chance(thing, share):
    checked = alone(thing.grams, share, 8)
    assert checked.settled == pytest.approx(0.4, abs=0.02) and checked.fault() is None
    # The editor itself, on 40 draws: the counts of 4 answers within a third of their mean.
    editor, truth = thing.editor(share), thing.truth("source")
    answers = []
    for seed in range(30):
        noise = torch.randn((1, 48, 16, 16), generator=torch.Generator().manual_seed(seed))
        result = edit(editor, [thing.before["source"]], "paint", steps=8, noise=noise)
        answers.append(part_answers(result.images[0], truth, PARTS))
    counts = np.bincount(np.concatenate(answers)[np.concatenate(answers) >= 0], minlength=4)
    assert counts.sum() > 150 and np.abs(counts / counts.mean() - 1).max() < 1 / 3


def figures(thing, share, warps, seeds=(0, 1, 2, 3), **changes):
    """Mean seen and through of an edit by Algorithm 1."""
    of, rows = world("spheres", 64), []
    for seed in seeds:
        settings = preset(
            "attention_warping",
            stages=1,
            steps=8,
            iterations=0,
            noise="fresh",
            seed=seed,
            **changes,
        )
        pictures = [thing.before[name] for name in VIEWS]
        cameras = [of.camera(name) for name in VIEWS]
        result = attention_warping(
            model(), cameras, pictures, thing.editor(share), "paint", settings, warps=warps
        )
        edited = {VIEWS[k]: image / np.float32(255) for k, image in result.edited.items()}
        answers = part_answers(edited["source"], thing.truth("source"), PARTS)
        for name in VIEWS[1:]:
            pair = of.pair(name, 64)
            nothing = np.full(pair.label.shape, -1, np.int16)
            one = part_figures(
                edited[name],
                thing.truth(name),
                answers,
                pair.visible,
                pair.label == HIDDEN,
                nothing,
            )
            rows.append(one["parts.seen"])
    return float(np.nanmean(rows))


def test_the_assay_sees_geometry(thing, share):
    """A warp that is mirrored or displaced by an eighth fails at 12 parts, as it must."""
    right = figures(thing, share, exact, decay="constant")
    wrong = figures(
        thing, share, lambda *pair: MovedView.of(exact(*pair), "mirrored"), decay="constant"
    )
    displaced = figures(
        thing, share, lambda *pair: MovedView.of(exact(*pair), "displaced"), decay="constant"
    )
    apart = figures(thing, share, exact, a0=0.0)
    assert right > 0.55 and max(wrong, displaced, apart) < 0.45


def seen_alike(model, source, target, drop):
    """(N,) bool: normals turned to each camera, in that camera's axes, are at most 60 degrees apart, as the paper
    means it; with ``drop`` those that are not, as it prints it.
    """
    seen = []
    for camera in (source, target):
        normals = model.normals().double().numpy() @ camera.world_to_camera[:3, :3].T
        centres = (
            model.world_means() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        )
        away = (normals * centres).sum(axis=1) > 0
        seen.append(np.where(away[:, None], -normals, normals))
    return ((seen[0] * seen[1]).sum(axis=1) >= 0.5) != drop


def warp_of_the_text(source, target, drop=False):
    """(16, 16, 2) positions in the source's tokens and (16, 16) mask: "inside the image", with the depth of the
    Gaussians that are kept.
    """
    splats = model()
    kept = splats.select(torch.from_numpy(seen_alike(splats, source, target, drop)))
    z = render(kept, target, backend="reference").depth.double().numpy()

    def project(depth, camera):
        """Positions in the source of a grid of the target with a depth each, in shares of the picture."""
        h, w = depth.shape
        row, column = np.mgrid[:h, :w] + 0.5
        x, y = column * camera.width / w, row * camera.height / h
        K, to_world = camera.K, np.linalg.inv(camera.world_to_camera)
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
        world_points = (rays * depth[..., None]) @ to_world[:3, :3].T + to_world[:3, 3]
        X, Y, Z = np.moveaxis(
            world_points @ source.world_to_camera[:3, :3].T + source.world_to_camera[:3, 3], -1, 0
        )
        u, v = source.K[0, 0] * X / Z + source.K[0, 2], source.K[1, 1] * Y / Z + source.K[1, 2]
        return np.stack([u / source.width, v / source.height], -1)

    # A token's centre lies between four pixels, whose depth is a mean in 1 / z; over an edge there is none.
    taps = np.stack([z[i::4, j::4] for i in (1, 2) for j in (1, 2)])
    edge = ~(taps.max(axis=0) <= 1.05 * taps.min(axis=0))
    xy = project(np.where(edge, np.nan, 4 / (1 / taps).sum(axis=0)), target)
    pixels = project(z, target)
    inside = ((pixels >= 0) & (pixels <= 1)).all(axis=-1)
    share = inside.reshape(16, 4, 16, 4).mean(axis=(1, 3))
    return 16 * xy, (share > 0.5) & ~np.isnan(xy).any(axis=-1)


@pytest.fixture(scope="module")
def wide(coarse_textures):
    """The thing from the front and from the side, where many normals are more than 60 degrees apart."""
    of = world("spheres", 64)
    cameras = [of.camera(name) for name in ("source", "yaw090")]
    return Thing.of(of.scene, of.geometry, cameras, SPHERES, parts=PARTS, colors=4, spp=1)


@pytest.mark.parametrize("choices", ["corrected", "paper"])
def test_propagation_is_the_loop_written_out_in_float64(thing, wide, share, choices):
    """Algorithm 1's picture of a view by hand: evidence, warp, mask, blend, at every step.

    The warp of ``corrected`` is exact and its own; that of ``paper`` is written out too, from the splats.
    """
    of = world("spheres", 64)
    thing = thing if choices == "corrected" else wide
    names = list(thing.before)
    settings = preset(
        "attention_warping", choices, stages=1, steps=8, iterations=0, noise="shared", seed=5
    )
    cameras, pictures = [of.camera(name) for name in names], list(thing.before.values())
    editor = thing.editor(share)

    def propagate(settings):
        warps = exact if choices == "corrected" else None
        return attention_warping(
            model(), cameras, pictures, editor, "paint", settings, warps=warps
        ).edited

    edited = propagate(settings)

    alphas = editor.schedule.alphas.double().numpy()
    timesteps = editor.schedule.timesteps(8)
    noise = torch.randn((1, 48, 16, 16), generator=torch.Generator().manual_seed(5))[0]
    start = noise.flatten(1).T.double().numpy()

    def tokens(picture):
        cells = (2 * picture.astype(np.float64) - 1).reshape(16, 4, 16, 4, 3)
        return cells.transpose(0, 2, 4, 1, 3).reshape(256, 48)

    def run(name, taken=None):
        before = tokens(thing.before[name])
        change = np.stack([tokens(one) - before for one in thing.after[name]])
        parts = thing.tokens(name).ravel()
        x, kept = start.copy(), []
        for step, now in enumerate(timesteps):
            a = alphas[now]
            own = np.zeros((256, 4))
            for p in set(parts[parts >= 0].tolist()):
                among = parts == p
                evidence = [
                    (
                        a**0.5 * ((x - a**0.5 * before)[among] * d[among]).sum()
                        - a / 2 * (d[among] ** 2).sum()
                    )
                    / (1 - a)
                    for d in change
                ]
                own[among] = (np.array(evidence) - np.mean(evidence)) / among.sum()
            s = own if taken is None else blend(taken[step][0], own, step)
            sizes = np.array([(parts == p).sum() for p in parts])[:, None]
            w = np.exp(sizes * s - (sizes * s).max(axis=1, keepdims=True))
            w /= w.sum(axis=1, keepdims=True)
            u = np.einsum("nk,knc->nc", w, change) * (parts >= 0)[:, None]
            kept.append((own, u))
            u = u if taken is None else blend(taken[step][1], u, step)
            clean = before + u
            b = alphas[timesteps[step + 1]] if step + 1 < len(timesteps) else 1.0
            x = b**0.5 * clean + (1 - b) ** 0.5 * (x - a**0.5 * clean) / (1 - a) ** 0.5
        return x, kept

    if choices == "corrected":
        layer = exact(0, 1).at((16, 16))
        xy, mask = layer.correspondence.xy.numpy(), layer.mask.numpy()
    else:
        xy, mask = warp_of_the_text(*cameras)

    def blend(source, own, step):
        weight, result = 0.9 * (8 - step) / 8, own.copy()
        grid = source.reshape(16, 16, -1)
        for y, x in itertools.product(range(16), range(16)):
            if not mask[y, x]:
                continue
            u, v = np.clip(xy[y, x] - 0.5, 0, 15)
            left, top = int(u), int(v)
            right, below, du, dv = min(left + 1, 15), min(top + 1, 15), u - left, v - top
            warped = (1 - dv) * ((1 - du) * grid[top, left] + du * grid[top, right]) + dv * (
                (1 - du) * grid[below, left] + du * grid[below, right]
            )
            result[16 * y + x] = weight * warped + (1 - weight) * own[16 * y + x]
        return result

    def picture(x):
        cells = x.reshape(16, 16, 3, 4, 4).transpose(0, 3, 1, 4, 2).reshape(64, 64, 3)
        return np.clip(cells / 2 + 0.5, 0, 1)

    source, kept = run("source")
    target, _ = run(names[1], kept)
    for number, expected in ((0, source), (1, target)):
        assert np.abs(edited[number] / 255 - picture(expected)).max() <= 1 / 255
    assert np.abs(picture(run(names[1])[0]) - picture(target)).max() > 20 / 255
    if choices == "paper":
        printed = propagate(
            replace(settings, warp=replace(settings.warp, gaussian_filter="printed"))
        )
        assert np.abs(printed[1] / 255 - picture(target)).max() > 20 / 255
        xy, mask = warp_of_the_text(*cameras, drop=True)
        dropped, _ = run(names[1], kept)
        assert np.abs(printed[1] / 255 - picture(dropped)).max() <= 1 / 255


def test_metal_is_painted_matt():
    """The oracle is the same bear of bronze, its looks written by hand as a file would say them."""
    bear = load_scene("bear")
    bronze = next(edit for edit in bear.spec.edits if edit.name == "bronze")
    statue = Scene(apply(bear.spec, bronze), bear.path)
    written = statue.spec.model_dump(mode="json", exclude_unset=True)
    for item in written["objects"]:
        if item["name"] == "bear":
            item["material"] = {"type": "diffuse"}
            item["texture"] = {"type": "plain", "color": "#c04040"}
    edited = painted(statue, ["bear"], "#c04040")
    assert edited.spec.objects == type(statue.spec).model_validate(written).objects
