# ruff: noqa: F811  (fixtures that are imported)
"""Methods of 2025 and 2026 against their formulas, in float64 and pixel by pixel; walls that face the cameras have warps in closed form."""

from pathlib import Path

import numpy as np
import pytest
import tiny_editors
import torch
from tiny_methods import QUICK, close, depth_editor, editor, run, scene  # noqa: F401

from attnwarp import Camera
from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from attnwarp.editing.layers import BareUNet, all_layers
from attnwarp.editing.schedule import DDIM
from attnwarp.fit import Views
from attnwarp.methods import ByViewSettings, GuidedSettings
from attnwarp.methods.algorithms.corresponding import mixing
from attnwarp.methods.algorithms.fused import blended, guided_by, splat
from attnwarp.methods.algorithms.guided import Guided, guided_step, mosaic
from attnwarp.methods.algorithms.warped_reference import WarpedReference
from attnwarp.methods.work import Work
from attnwarp.reporting import SILENT
from attnwarp.warp import Surface, warp_surfaces
from attnwarp.workdir import Workdir

SIDE = 8


def row(steps):
    """Cameras before a wall at depth 2; a step of .25 moves the picture by one of 8 px."""
    K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
    poses = []
    for step in steps:
        pose = np.eye(4)
        pose[0, 3] = -0.25 * step
        poses.append(Camera(K, pose, SIDE, SIDE))
    return poses


def wall(camera):
    return Surface(np.full((SIDE, SIDE), 2.0), np.broadcast_to([0.0, 0, -1], (SIDE, SIDE, 3)))


def between(views):
    return lambda source, target: warp_surfaces(
        views[source], views[target], wall(views[target]), wall(views[source])
    )


def at(tokens, side, x, y):
    """Tokens (n, C) of a side x side grid, linear in x at a position in cells."""
    grid, place = tokens.reshape(side, side, -1), min(max(x - 0.5, 0), side - 1)
    left = int(np.floor(place))
    right, share = min(left + 1, side - 1), place - left
    return (1 - share) * grid[y, left] + share * grid[y, right]


def test_a_token_is_the_softmax_of_what_all_views_show_of_its_point():
    """CoreEditor: softmax over views l of <h_f(p), h_l(W_l p)> / sqrt(d), where l sees the point."""
    network = tiny_editors.unet(8).double().requires_grad_(False)
    branches, steps = ("text", "image"), (0, 2, -1)
    layers = [layer for layer in all_layers(network) if layer.kind == "self"]
    before, after = {}, {}

    def noting(into, name):
        return lambda module, args, output: into.__setitem__(name, output.numpy().copy())

    for layer in layers:
        network.get_submodule(layer.name).register_forward_hook(noting(before, layer.name))
    views, random = row(steps), torch.Generator().manual_seed(0)
    x = torch.randn((6, 8, SIDE, SIDE), generator=random, dtype=torch.float64)
    text = torch.randn((6, 5, 32), generator=random, dtype=torch.float64)
    with mixing(BareUNet(network, branches), layers, len(views), (SIDE, SIDE), between(views)):
        for layer in layers:
            network.get_submodule(layer.name).register_forward_hook(noting(after, layer.name))
        network(x, 500, encoder_hidden_states=text)
    sides = set()
    for layer in layers:
        h = before[layer.name]
        side, d = round(h.shape[1] ** 0.5), h.shape[2]
        sides.add(side)
        for number in range(len(branches)):
            for f in range(3):
                for p in range(side * side):
                    y, column = divmod(p, side)
                    own, values = h[3 * number + f, p], []
                    for k in range(3):
                        position = column + 0.5 + (steps[f] - steps[k]) * side / SIDE
                        # A cell of the lower layers is seen if more than half of its pixels are.
                        pixels = [
                            0 <= (column * SIDE // side + j + 0.5 + steps[f] - steps[k]) <= SIDE
                            for j in range(SIDE // side)
                        ]
                        if k == f or (np.mean(pixels) > 0.5 and 0 <= position <= side):
                            values.append(at(h[3 * number + k], side, position, y))
                    scores = np.exp([own @ value / np.sqrt(d) for value in values])
                    expected = scores / scores.sum() @ np.array(values)
                    assert np.abs(after[layer.name][3 * number + f, p] - expected).max() < 1e-9
        assert np.abs(after[layer.name] - h).max() > 1e-3
    assert sides == {8, 4}


CONSTANTS = [
    ("corresponding", "self_share", 0.7),
    ("corresponding", "batch", 1),
    ("warped_reference", "start", (900, 900)),
    ("fused", "nearest", 1),
    ("fused", "fusion_share", 0.5),
    ("fused", "occlusion", False),
    ("fused", "holes", "black"),
    ("fused", "start", (900, 980)),
    ("guided", "partners", 1),
    ("guided", "below", 500),
    ("guided", "forward", 0.0),
    ("guided", "backward", 1),
    ("guided", "rate", 0.1),
    ("guided", "points", 100),
    ("guided", "patches", 100),
    ("guided", "patch", 160),
    ("guided", "patch_weight", 0.0),
]


@pytest.fixture(scope="module")
def published():
    """Edited views with the published constants, by method and number of views."""
    return {}


@pytest.mark.parametrize(("method", "field", "value"), CONSTANTS)
def test_each_published_constant_changes_the_picture(method, field, value, run, scene, published):
    count = 3 if field in ("partners", "nearest") else 2
    model, *of_views = scene
    few = (model, *(each[:count] for each in of_views))
    quick = QUICK[method].changed(iterations=0, noise="shared")
    if (method, count) not in published:
        published[method, count] = run(method, quick, few).edited
    before = published[method, count]
    after = run(method, quick.changed(**{field: value}), few).edited
    assert not all(close(before[view], after[view]) for view in range(count))


# --- EditSplat


def test_pixels_are_splatted_forward_and_the_nearest_of_a_view_wins_where_the_rule_says():
    random = np.random.default_rng(0)
    xy = torch.from_numpy(random.uniform(-1, 7, (6, 6, 2)))
    xy[0, :2] = torch.tensor([[2.2, 3.9], [2.9, 3.1]])  # one cell
    z = torch.from_numpy(random.uniform(1, 3, (6, 6)))
    z[0, :2] = torch.tensor([1.5, 2.5])
    z[3, 3] = -1.0
    xy[4, 4] = torch.nan
    colors = random.random((6, 6, 3))
    for occlusion in (True, False):
        picture, depth = np.zeros((5, 6, 3)), np.full((5, 6), np.inf)
        for y in range(6):
            for x in range(6):
                (u, v), near = xy[y, x].tolist(), float(z[y, x])
                if not (0 <= u < 6 and 0 <= v < 5 and near > 0):
                    continue
                cell = int(v), int(u)
                if not occlusion or near < depth[cell]:
                    picture[cell], depth[cell] = colors[y, x], near
        got, distance = splat(colors, xy, z, (5, 6), occlusion)
        assert np.array_equal(got, picture) and np.array_equal(distance, depth)
        assert np.isinf(depth).any()


def test_views_are_blended_from_the_farthest_on_by_the_ratio_of_their_depths():
    """The nearer of two at depths d < D weighs D / (d + D), and so on to the nearest."""
    random = np.random.default_rng(1)
    pictures = random.random((4, 5, 6, 3))
    depths = np.where(random.random((4, 5, 6)) < 0.4, np.inf, random.uniform(1, 3, (4, 5, 6)))
    expected = np.zeros((5, 6, 3))
    for y in range(5):
        for x in range(6):
            far = np.inf
            for k in sorted(range(4), key=lambda k: -depths[k, y, x]):
                d = depths[k, y, x]
                if np.isfinite(d):
                    back = 0.0 if np.isinf(far) else d / (d + far)
                    expected[y, x] = (1 - back) * pictures[k, y, x] + back * expected[y, x]
                    far = d
    picture, seen = blended([(pictures[k], depths[k]) for k in range(4)])
    assert np.abs(picture - expected).max() < 1e-12
    assert np.array_equal(seen, np.isfinite(depths).any(axis=0))


def test_the_guidance_of_fused_views_is_its_formula_of_six_rows():
    """e0(I) + 7.5 (eT(F) - eI(F)) + .5 (eI(I) - e0(I)) + 1.0 (eI(F) - e0(F))."""
    pipe = tiny_editors.pix2pix()
    for part in (pipe.unet, pipe.vae, pipe.text_encoder):
        part.double()
    editor = InstructPix2Pix(
        pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler,
        text_guidance=7.5, image_guidance=1.5,
    )  # fmt: skip
    random = np.random.default_rng(0)
    fusion, picture = (random.random((16, 16, 3)).astype(np.float32) for _ in range(2))
    task = guided_by(editor, fusion, picture, "a bear", None, 2 / 3)
    x = torch.randn((1, 4, 8, 8), generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def e(words, picture):
        text = editor.embed([words])
        latents = torch.zeros_like(x)
        if picture is not None:
            pixels = 2 * torch.from_numpy(picture).permute(2, 0, 1)[None].double() - 1
            latents = editor.vae.encode(pixels).latent_dist.mode()
        with torch.no_grad():
            return editor.unet(torch.cat([x, latents], 1), 500, encoder_hidden_states=text).sample

    none = e("", None)
    text_of_fusion, of_fusion, of_picture = e("a bear", fusion), e("", fusion), e("", picture)
    expected = none + 7.5 * (text_of_fusion - of_fusion)
    expected += 0.5 * (of_picture - none) + 1.0 * (of_fusion - none)
    rows = []
    handle = editor.unet.register_forward_pre_hook(lambda _, args: rows.append(len(args[0])))
    with torch.no_grad():
        got = task.predict(x, 500)
    handle.remove()
    assert rows == [6]
    assert (got - expected).abs().max() < 1e-6  # pictures pass in float32


# --- Correspondence Guidance


def test_a_guided_step_is_universal_guidance_written_out():
    """With noise e = M x and the loss L = ||x_0 - b||^2 / 2 all gradients g are known; a step is L g / ||g||^2."""
    random = torch.Generator().manual_seed(0)
    M, x, b = (
        torch.randn(shape, generator=random, dtype=torch.float64) for shape in ((9, 9), 9, 9)
    )
    alphas = torch.linspace(0.99, 0.01, 1000, dtype=torch.float64)
    a, after, s, rate = alphas[600], alphas[550], 0.2, 0.05

    def polyak(z, g):
        return (z - b).square().sum() / 2 * g / g.square().sum()

    noise = M @ x
    clean = (x - (1 - a).sqrt() * noise) / a.sqrt()
    through = (torch.eye(9, dtype=torch.float64) - (1 - a).sqrt() * M) / a.sqrt()
    noise = noise + s * (1 - a).sqrt() * polyak(clean, through.T @ (clean - b))
    clean, moved = (x - (1 - a).sqrt() * noise) / a.sqrt(), torch.zeros_like(x)
    for _ in range(3):
        moved = moved - rate * polyak(clean + moved, clean + moved - b)
    noise = noise - (a / (1 - a)).sqrt() * moved
    clean = (x - (1 - a).sqrt() * noise) / a.sqrt()
    expected = after.sqrt() * clean + (1 - after).sqrt() * noise

    got = guided_step(
        DDIM(alphas, "epsilon", 1.0),
        lambda z, _: (M @ z.flatten()).reshape(z.shape),
        lambda z: (z.flatten() - b).square().sum() / 2,
        x.reshape(1, 1, 3, 3), 600, 550, s, 3, rate,
    )  # fmt: skip
    assert (got.flatten() - expected).abs().max() < 1e-12


def test_patches_are_cut_around_their_points_and_laid_side_by_side():
    random = np.random.default_rng(0)
    picture = random.random((3, 9, 7))
    centers = np.array([[2.5, 3.5], [4.5, 5.5], [3.5, 1.5], [0.5, 8.5], [6.0, 6.0]])
    got = mosaic(torch.from_numpy(picture), torch.from_numpy(centers), 3).numpy()
    assert got.shape == (6, 6, 3)  # four of the five points make a square
    for k, (x, y) in enumerate(centers[:4]):
        for i in range(3):
            for j in range(3):
                row, column = (
                    int(np.clip(v, 0, n - 1)) for v, n in ((y + i - 1.5, 9), (x + j - 1.5, 7))
                )
                cell = got[3 * (k // 2) + i, 3 * (k % 2) + j]
                assert np.abs(cell - picture[:, row, column]).max() < 1e-12


def test_the_loss_is_l1_and_twice_the_distance_of_patches_at_matched_points(scene, editor):
    """Every pixel of a wall is matched with itself: twins, as many points as pixels."""
    model, views, images = scene
    twins = [Camera(views[1].K, views[1].world_to_camera, 32, 32, f"{k}.png") for k in range(2)]
    settings = GuidedSettings(patches=10, patch=128)
    seen = Views(twins, [images[1]] * 2)
    folder = Workdir(Path("unused"), "an edit")
    work = Work(model, seen, editor, "a bear", settings, "auto", folder, SILENT)
    guide = Guided(work, settings, 0, None)
    edited = np.random.default_rng(0).random((32, 32, 3)).astype(np.float32)
    guide.kept = lambda number, view: edited
    warp = guide.of_edits(0, 1)
    pixels = torch.rand((3, 32, 32), generator=torch.Generator().manual_seed(0))
    mask = warp.mask.numpy()
    l1 = np.abs(pixels.permute(1, 2, 0).numpy() - edited)[mask].mean()
    losses = []
    for weight in (0.0, 1.0, 2.0):
        guide.settings = settings.changed(patch_weight=weight)
        losses.append(float(guide.loss(0, warp, 1)(pixels)))
        same = guide.loss(0, warp, 1)(torch.from_numpy(edited).permute(2, 0, 1))
        assert abs(float(same)) < 1e-6
    assert abs(losses[0] - l1) < 1e-6
    assert abs((losses[2] - l1) - 2 * (losses[1] - l1)) < 1e-6 < losses[1] - l1


@pytest.mark.parametrize("method", ["warped_reference", "guided"])
def test_the_source_that_is_asked_for_is_edited_first_and_alone(method, run):
    """Oracle: view by view, at the same noise."""
    quick = QUICK[method].changed(iterations=0)
    edited = run(method, quick, source=2).edited
    plain = {k: v for k, v in quick.to_dict().items() if k in ByViewSettings().to_dict()}
    alone = run("by_view", ByViewSettings(**{**plain, "start": None})).edited
    assert next(iter(edited)) == 2
    assert close(edited[2], alone[2]) and not close(edited[0], alone[0])


def test_a_start_from_a_white_edit_is_white_and_no_more(scene, editor):
    """Weights of four taps add up to more than 1 in float32, and encoders refuse such pictures."""
    model, views, images = scene
    settings = QUICK["warped_reference"]
    folder = Workdir(Path("unused"), "an edit")
    seen = Views(views, images)
    work = Work(model, seen, editor, "a bear", settings, "auto", folder, SILENT)
    method = WarpedReference(work, settings, 0, None)
    method.kept = lambda number, view: np.ones((32, 32, 3), np.float32)
    for view in (1, 2):
        picture, share = method.starts(view)
        assert 0.1 < share < 1
        assert picture.max() == 1
