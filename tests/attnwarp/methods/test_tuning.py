"""Oracles: the order written out, finite differences, a picture's own loss."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_scenes import cameras, pictures, splats

from attnwarp import Camera, Gaussians
from attnwarp.encoders import load_encoder
from attnwarp.fit import Views
from attnwarp.gaussians import SH_C0
from attnwarp.methods import preset
from attnwarp.methods.scene import near_of, render_picture
from attnwarp.methods.stages import released_order
from attnwarp.methods.tuning import DistanceToViews, Tuning
from attnwarp.render import render
from attnwarp.trial import disc, view
from attnwarp.workdir import Workdir

SETTINGS = preset("attention_warping", iterations=40)


def views_of(count, size=32):
    place = cameras(1)[0]
    return Views([place] * count, [np.zeros((size, size, 3), np.float32)] * count)


def visited(count, order=None, iterations=400):
    tuning = Tuning(splats(), cameras(), replace(SETTINGS, perceptual=0.0), iterations)
    views, seen = views_of(count), []
    tuning._iterate = lambda views, index: (
        seen.append(index),
        setattr(tuning, "iteration", len(seen)),
    )
    tuning.advance(0, iterations, views, range(count), order)
    return seen


def test_the_released_order_never_visits_four_of_forty_views():
    # The source is view 0 of those that are tuned on.
    order = visited(41, released_order(40))
    assert order == [0 if step % 10 == 0 else 1 + step % 40 for step in range(400)]
    assert set(range(1, 41)) - set(order) == {1, 11, 21, 31}


def test_otherwise_every_view_is_visited_once_in_each_round():
    order = visited(40)
    for start in range(0, 400, 40):
        assert sorted(order[start : start + 40]) == list(range(40))
    assert order[:40] != order[40:80]


def test_tuning_recolours_the_scene_to_its_pictures():
    start, views = splats(), cameras()
    goal = replace(start, sh=start.sh.flip(-1))  # red and blue exchanged
    training = Views(views, pictures(goal, views))
    tuning = Tuning(start, views, replace(SETTINGS, color_rate=20.0), 250)

    def error():
        return sum(
            float((render(tuning.gaussians(), camera).color - torch.from_numpy(picture)).abs().mean())
            for camera, picture in zip(views, training.images, strict=True)
        )  # fmt: skip

    before = error()
    tuning.advance(0, 250, training, range(len(views)))
    assert error() < 0.3 * before
    assert sum(tuning.visits.values()) == 250


def lifted(views, start, times=1, membership=None):
    tuning = Tuning(start, views.cameras, SETTINGS, 1, membership=membership)
    for _ in range(times):
        tuning.lift(views)
    return tuning.gaussians()


def test_lifting_finds_the_colours_of_recoloured_splats_whatever_masks_hide():
    start, views = splats(), cameras()
    goal = replace(start, sh=start.sh.clone())
    goal.sh[:, 0] += torch.tensor([0.5, 0.2, -0.3])
    kept = np.arange(32)[None].repeat(32, 0) > 9
    shown = [np.where(kept[..., None], p, np.float32(1)) for p in pictures(goal, views)]
    asked = Views(views, shown, masks=[kept] * len(views))

    def error(colors):
        return float((colors.sh[:, 0] - goal.sh[:, 0]).abs().mean())

    assert error(lifted(asked, start)) < 0.05 * error(start)
    member = np.arange(len(start)) % 2
    bound = lifted(asked, start, membership=member.astype(np.float64))
    assert torch.equal(bound.sh[member == 0], start.sh[member == 0])
    assert not torch.equal(bound.sh[member == 1], start.sh[member == 1])
    assert torch.equal(bound.means, start.means) and torch.equal(bound.sh[:, 1:], start.sh[:, 1:])


def test_a_lifted_splat_takes_the_colour_on_which_most_views_agree_though_it_was_black():
    # A colour below black, as fits leave them, draws as black and has no slope.
    place, black = view(side=16), Gaussians.sh_from_rgb(torch.full((1, 3), -0.5))
    asked = [np.full((16, 16, 3), value, np.float32) for value in (0.8, 0.2, 0.8)]
    shown = render(lifted(Views([place] * 3, asked), replace(disc(20.0), sh=black), 4), place)
    assert torch.allclose(shown.color, torch.tensor(0.8), atol=0.02)  # their mean is 0.6


def test_a_picture_exposed_four_times_as_bright_asks_for_a_quarter_of_its_change():
    place, brighter = view(side=16), np.c_[np.diag([3.0] * 3), [0.1] * 3]  # shows 4 c + 0.1
    asked = Views([place], [np.full((16, 16, 3), 0.9, np.float32)], exposures=[brighter])
    shown = render(lifted(asked, disc(20.0)), place)
    assert torch.allclose(shown.color, torch.tensor(0.2), atol=0.01)


def densely_lifted(views, start):
    """Colours (N, 3) after three sweeps, by dense matrices in float64 and a loop over pixels'
    channels, before and after a clamp at black."""
    one_hot = torch.eye(len(start))
    shares = [render(start, c, features=one_hot).color.double().numpy() for c in views.cameras]
    colors = 0.5 + SH_C0 * start.sh[:, 0].double().numpy()
    for _ in range(3):
        change, weight = np.zeros_like(colors), np.zeros_like(colors)
        for k, share in enumerate(shares):
            gain, offset = np.eye(3), np.zeros(3)
            if views.exposures[k] is not None:
                gain, offset = gain + views.exposures[k][:, :3], views.exposures[k][:, 3]
            kept = np.ones(share.shape[:2], bool) if views.masks[k] is None else views.masks[k]
            for a, target in zip(share[kept], views.images[k][kept].astype(float), strict=True):
                slope = np.einsum("i,oc->oic", a, gain)
                missing = target - np.einsum("oic,ic->o", slope, np.maximum(colors, 0)) - offset
                trust = 1 / max(np.abs(missing).mean(), 0.03)
                change += trust * np.einsum("oic,o->ic", slope, missing)
                weight += trust * np.outer(a, np.abs(gain).sum(1) @ np.abs(gain))
        colors += np.where(weight > 0, change / np.maximum(weight, 1e-3), 0)
    return colors


ODD = {
    "saturated": {"images": [0.0, 1.0, 1.0]},
    "contradicting": {"images": [0.1, 0.9]},
    "a view that masks ignore": {"images": [0.2, 1.0], "masks": [None, np.zeros((16, 16), bool)]},
    "exposed from a hundredth to a hundred": {
        "images": [0.004, 1.0, 0.5],
        "exposures": [np.c_[np.diag(g - 1), [0.0] * 3] for g in np.outer([0.01, 100, 1], [1] * 3)],
    },
    "channels that mix": {"images": [0.5], "exposures": [np.full((3, 4), 0.2)]},
    "far from any colour": {"images": [0.5, 0.5], "factor": 1e4},
    "at the end of float32": {"images": [0.5, 0.5], "factor": 1e38},
}


@pytest.mark.parametrize("case", ODD)
def test_lifting_is_a_dense_solution_in_float64_also_in_hard_cases(case):
    """With splats that are huge, tiny, edge-on, hardly seen behind three others, and behind
    the cameras, which keep their bytes."""
    known = {"factor": 1.0, **ODD[case]}
    count, start = len(known["images"]), splats(8)
    means, scales, opacities = start.means.clone(), start.scales.clone(), start.opacities.clone()
    means[7], scales[0], scales[1], scales[5] = torch.tensor([0.0, 0, 9]), 1e3, 1e-6, 0.01
    means[2:6], opacities[2:5] = torch.tensor([[0.1, 0.1, z] for z in (0.03, 0.02, 0.01, 0)]), 0.99
    opacities[5] = 0.02  # damped: all pixels together have about 1e-5 of it
    quats = start.quats.clone()
    quats[6] = torch.tensor([1.0, 1, 0, 0]) / 2**0.5  # turned by a right angle
    start = replace(
        start, means=means, scales=scales, opacities=opacities, quats=quats,
        sh=known["factor"] * start.sh,
    )  # fmt: skip
    images = [np.full((16, 16, 3), value, np.float32) for value in known["images"]]
    nothing = [None] * count
    views = Views.unchecked(
        cameras(count, 16), images, known.get("masks", nothing), known.get("exposures", nothing)
    )
    found = lifted(views, start).sh[:, 0]
    colors = 0.5 + SH_C0 * found.double().numpy()
    np.testing.assert_allclose(colors, densely_lifted(views, start), rtol=2e-3, atol=2e-4)
    assert torch.equal(found[7], start.sh[7, 0])


def test_a_sweep_that_the_budget_ends_changes_nothing(monkeypatch):
    start, views = splats(8), cameras(2, 16)
    goal = Views(views, [np.full((16, 16, 3), value, np.float32) for value in (0.2, 0.9)])

    def after(views_left):
        tuning, asked, steps = Tuning(start, views, SETTINGS, 1), iter(range(99)), []
        tuning.lift(goal, spent=lambda: next(asked) >= views_left, step=lambda: steps.append(1))
        assert len(steps) <= views_left
        return tuning.gaussians().sh

    assert torch.equal(after(1), start.sh) and torch.equal(after(3), after(2))
    assert torch.equal(after(99), lifted(goal, start).sh)
    monkeypatch.setattr("attnwarp.methods.tuning.LIFT_SWEEPS", 1)
    assert torch.equal(after(2), lifted(goal, start).sh)


def test_only_rounds_with_iterations_of_lifted_training_begin_with_lifting():
    start, views = splats(), cameras()
    goal = Views(views, [np.full((c.height, c.width, 3), 0.5, np.float32) for c in views])

    def moved(training, iterations, spent=False):
        settings = replace(SETTINGS, training=training, perceptual=0.0)
        tuning = Tuning(start, views, settings, 40)
        tuning.advance(0, iterations, goal, range(len(views)), spent=lambda: spent)
        return float((tuning.gaussians().sh[:, 0] - start.sh[:, 0]).abs().max())

    # Adam moves a coefficient by its rate, 0.01, in a step.
    assert moved("lifted", 0) == 0 == moved("lifted", 1, spent=True)
    assert moved("all", 1) < 0.02 < moved("lifted", 1)


def test_a_splat_takes_the_share_of_a_step_that_it_belongs():
    start, views = splats(), cameras()
    target = Views(views, [np.ones((c.height, c.width, 3), np.float32) for c in views])
    share = np.tile([0.0, 0.25, 1.0], len(start))[: len(start)]

    def moved(steps, membership=None):
        settings = replace(SETTINGS, perceptual=0.0)
        tuning = Tuning(start, views, settings, steps, membership=membership)
        origin = {name: tensor.detach().clone() for name, tensor in tuning.model.tensors.items()}
        tuning.advance(0, steps, target, range(len(views)), lambda number: number % len(target))
        return {n: t.detach() - origin[n] for n, t in tuning.model.tensors.items()}

    whole, parts = moved(1), moved(1, share)
    for name, step in parts.items():
        expected = whole[name] * torch.from_numpy(share).float().reshape(
            -1, *[1] * (step.dim() - 1)
        )
        assert torch.allclose(step, expected, atol=1e-6), name
    assert all(not step[share == 0].any() for step in moved(20, share).values())
    assert parts["dc"][share == 1].abs().max() > 1e-4


def test_the_perceptual_loss_is_the_distance_and_its_gradient_is_the_slope():
    net = load_encoder("perceptual-small", "perceptual")
    random = torch.Generator().manual_seed(0)
    image, target, way = (torch.rand((32, 24, 3), generator=random) for _ in range(3))
    assert float(net.loss(image, target)) == pytest.approx(
        net.distance([image.numpy()], [target.numpy()])[0], rel=1e-5
    )
    assert float(net.loss(target, target)) == 0
    net.net.double()
    try:
        x = image.double().requires_grad_(True)
        net.loss(x, target.double()).backward()
        slope = float((x.grad * way).sum())
        step = 1e-5
        ahead, behind = (
            float(net.loss(x.detach() + s * way, target.double())) for s in (step, -step)
        )
        # ReLU has kinks; along so short a step few are crossed.
        assert slope == pytest.approx((ahead - behind) / (2 * step), rel=1e-3)
    finally:
        net.net.float()


def test_tuning_ignores_what_masks_ignore_and_knows_the_exposure_of_each_picture():
    """Oracles: the same bits whatever is under a mask; pictures that are exposed renders, which
    leave the splats as they are."""
    start, views = splats(), cameras()
    shown = pictures(start, views)
    kept = np.arange(32)[None].repeat(32, 0) > 9
    change = np.array([[-0.1, 0, 0, 0.05], [0, -0.2, 0, 0], [0, 0.1, -0.2, 0.02]])
    behind = [np.where(kept[..., None], p, np.float32(v)) for p in shown for v in (0, 1)]

    def tuned(images, steps=6, **more):
        settings = replace(SETTINGS, ssim=0.2, background="black")
        tuning = Tuning(start, views, settings, steps)
        tuning.advance(0, steps, Views(views, images, **more), range(len(views)))
        return tuning.gaussians().sh

    masks = [kept] * len(views)
    black, white = (tuned(behind[k::2], masks=masks) for k in (0, 1))
    assert torch.equal(black, white) and not torch.equal(black, tuned(behind[::2]))
    exposed = [np.float32(p + p @ change[:, :3].T + change[:, 3]) for p in shown]
    views_of = Views(views, exposed, exposures=[change] * len(views))
    tuning = Tuning(start, views, replace(SETTINGS, normal=0.0, distortion=0.0), 1)
    loss = [float(tuning.loss_of(render(start, c), views_of, k)) for k, c in enumerate(views)]
    plain = float(tuning.loss_of(render(start, views[0]), Views(views, exposed), 0))
    assert max(loss) < 1e-4 < 1e-2 < plain


class Counting:
    """A perceptual distance that counts the pictures that go through its network."""

    def __init__(self):
        self.net, self.pictures = load_encoder("perceptual-small", "perceptual"), 0

    def features(self, picture):
        self.pictures += 1
        return self.net.features(picture)

    def between(self, image, target):
        return self.net.between(image, target)


@pytest.mark.parametrize(("kept", "passes"), [(2**30, 3), (2**18, 9), (0, 12)])
def test_a_views_picture_goes_through_the_network_once_while_it_fits(kept, passes):
    net, random = Counting(), torch.Generator().manual_seed(1)
    place = cameras(1)[0]
    images = [torch.rand((32, 32, 3), generator=random).numpy() for _ in range(3)]
    views = Views([place] * 3, images)
    distance = DistanceToViews(net, kept)
    for _ in range(4):
        for k, image in enumerate(images):
            render = torch.rand((32, 32, 3), generator=random).requires_grad_(True)
            found = distance(render, views, k)
            expected = net.net.loss(render, torch.from_numpy(image))
            assert torch.equal(found, expected)
            slopes = [torch.autograd.grad(value, render)[0] for value in (found, expected)]
            assert torch.equal(*slopes)
    # Of 32 x 32 px features have 205 kB: one view's fit into the middle bound.
    assert net.pictures == 12 + passes


def test_features_of_a_view_go_with_it():
    net = Counting()
    distance = DistanceToViews(net)
    picture = torch.zeros((32, 32, 3))
    for _ in range(3):
        distance(picture, Views(cameras(1), [picture.numpy()]), 0)
        assert len(distance._kept) == 0
    assert net.pictures == 6


@pytest.mark.parametrize("unit", [2.0**-12, 2.0**12])
def test_views_from_one_place_are_drawn_and_tuned_alike_in_any_unit(unit):
    """Powers of two leave every digit as it is."""
    position = cameras(1)[0].position

    def tuned(k):
        start = replace(splats(), means=k * splats().means, scales=k * splats().scales)
        view = Camera.look_at(k * position, (0, 0, 0), width=32, height=32, fov_y=40, up=(0, 1, 0))
        target = Views([view], [np.zeros((32, 32, 3), np.float32)])
        tuning = Tuning(start, [view], replace(SETTINGS, perceptual=0.0), 3)
        tuning.advance(0, 3, target, [0])
        return render_picture(start, view, near_of([view], start), "auto"), tuning.gaussians()

    (drawn, one), (other_drawn, other) = tuned(1.0), tuned(unit)
    assert drawn.max() > 0.2
    np.testing.assert_allclose(other_drawn, drawn, atol=1e-5)
    assert float((one.sh - splats().sh).abs().max()) > 1e-3
    torch.testing.assert_close(other.sh, one.sh, rtol=0, atol=1e-5)
    torch.testing.assert_close(other.means / unit, one.means, rtol=0, atol=1e-5)


FAR = np.array([1e6, -2e6, 5e5])


def test_a_checkpoint_gives_the_centres_that_it_was_written_with(tmp_path):
    """Oracle: the start."""
    start = splats().to(dtype=torch.float64)
    start = replace(start, means=start.means + torch.from_numpy(FAR))
    views = [camera.moved(FAR) for camera in cameras()]
    folder = Workdir(tmp_path, "an edit")
    folder.save("1.pt", Tuning(start, views, SETTINGS, 1).state())
    tuning = Tuning(start, views, SETTINGS, 1)
    tuning.restore(folder, "1.pt")
    # float32 has a step of 0.125 at 2e6.
    error = np.abs(tuning.gaussians().world_means() - start.world_means()).max()
    assert error < 1e-6


def test_a_checkpoint_of_another_origin_brings_its_own(tmp_path):
    start = splats()
    moved = replace(start, origin=FAR)
    folder = Workdir(tmp_path, "an edit")
    folder.save("1.pt", Tuning(moved, [c.moved(FAR) for c in cameras()], SETTINGS, 1).state())
    tuning = Tuning(start, cameras(), SETTINGS, 1)
    tuning.restore(folder, "1.pt")
    assert np.array_equal(tuning.gaussians().world_means(), moved.world_means())
