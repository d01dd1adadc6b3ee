"""Masks lifted through splats: against rays in float64, a dense solution, and a ball on a plane."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians
from attnwarp.warp import lift_masks, lifting, piece_around

BALL = 1500
"""Discs on the ball."""


def camera(position, size=96, **more):
    return Camera.look_at(
        position, (0, 0, 0.3), width=size, height=size, fov_y=40, up=(0, 0, 1), **more
    )


def quats(normals):
    """Rotations that turn z into each unit normal."""
    n = torch.tensor(np.asarray(normals))
    q = torch.stack([1 + n[:, 2], -n[:, 1], n[:, 0], 0 * n[:, 0]], dim=-1)
    return torch.where(q.norm(dim=-1, keepdim=True) < 1e-6, torch.tensor([0.0, 1, 0, 0]).to(q), q)


def discs(places, normals, scale, color):
    count = len(places)
    return Gaussians(
        "2d", torch.tensor(np.asarray(places)).float(), quats(normals).float(),
        torch.full((count, 2), scale), torch.full((count,), 0.95),
        Gaussians.sh_from_rgb(torch.tensor(color).float().expand(count, 3)),
    )  # fmt: skip


def joined(*parts):
    fields = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(parts[0].kind, *(torch.cat([getattr(p, f) for p in parts]) for f in fields))


def ball_on_plane():
    """Discs on a ball of radius 0.5 over the origin, 3600 more on the plane under it, of one grey."""
    k = np.arange(BALL) + 0.5
    z, turn = 1 - 2 * k / BALL, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    normal = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 60), np.linspace(-1.5, 1.5, 60))
    flat = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    up = np.broadcast_to([0.0, 0, 1], flat.shape)
    grey = [0.5, 0.5, 0.5]
    return joined(
        discs(0.5 * normal + [0, 0, 0.5], normal, 0.018, grey), discs(flat, up, 0.03, grey)
    )


def ball_mask(view):
    """(H, W) bool: the pixel's central ray meets the ball, which nothing hides."""
    rays = view.directions() @ view.rotation
    toward = np.array([0, 0, 0.5]) - view.position
    along = (rays * toward).sum(-1) / np.linalg.norm(rays, axis=-1)
    return np.sum(toward**2) - along**2 < 0.25


def near_edge(mask, width):
    """(H, W) bool: within so many px of the mask's outline."""
    import cv2

    kernel = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    grown, shrunk = (f(mask.astype(np.uint8), kernel) for f in (cv2.dilate, cv2.erode))
    return grown != shrunk


def test_a_ball_seen_from_everywhere_is_exact_but_for_its_edge():
    scene = ball_on_plane()
    ring = [
        camera((3 * np.cos(a), 3 * np.sin(a), h))
        for a in np.arange(8) * np.pi / 4
        for h in (0.6, 2.0)
    ]
    lifted = lift_masks(scene, ring, [ball_mask(view) for view in ring])
    is_ball = np.arange(len(scene)) < BALL
    # Hardly anything sees into the crevice around the point of contact.
    clear = np.linalg.norm(scene.world_means(), axis=1) > 0.25
    assert ((lifted.membership > 0.5) == is_ball)[clear].all()
    assert lifted.reached.all() and lifted.disputed[clear].mean() < 0.02
    for position in ((2.5, 1.2, 1.3), (-1.0, -2.8, 0.9)):
        view = camera(position)
        true = ball_mask(view)
        wrong = (lifted.render(view) > 0.5) != true
        # Discs seen edge-on are drawn wider than they are, by the screen filter of 2DGS.
        assert not (wrong & ~near_edge(true, 3)).any()


def test_one_mask_of_a_ball_marks_its_back_too():
    scene = ball_on_plane()
    front, back = camera((3, 0, 1.0)), camera((-3, 0, 1.0))
    lifted = lift_masks(scene, [front], [ball_mask(front)])
    assert not lifted.seen[:BALL].all()
    true = ball_mask(back)
    mine = lifted.render(back) > 0.5
    assert (mine & true).sum() / (mine | true).sum() > 0.85


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_votes_are_the_weights_of_rays_through_splats_in_float64(kind):
    rng = np.random.default_rng(3)
    n = 14
    normals = rng.normal(size=(n, 3)) / 3 + [1, 0.2, 0.2]  # an edge-on disc would get a width
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    splats = Gaussians(
        kind, torch.tensor(rng.uniform(-0.6, 0.6, (n, 3))), quats(normals),
        torch.tensor(rng.uniform(0.15, 0.3, (n, 2 if kind == "2d" else 3))),
        torch.tensor(rng.uniform(0.2, 0.9, n)), torch.zeros(n, 1, 3, dtype=torch.float64),
        screen_filter=1e-4,
    )  # fmt: skip
    view = camera((4, 1, 1.0), 24)
    mask = rng.uniform(size=(24, 24)).astype(np.float32)
    all_count = np.ones((24, 24), dtype=bool)
    votes, total = lifting._votes(splats, mask, all_count, view, 0.01, "reference")
    weight = (rays_through_discs if kind == "2d" else projected_ellipsoids)(splats, view)
    want_votes, want_total = np.tensordot(weight, mask, 2), weight.sum((1, 2))
    # Below 1/255 nothing is drawn, which the rays know nothing of.
    assert np.abs(votes - want_votes).max() < 0.02 * want_total.max()
    assert np.abs(total - want_total).max() < 0.02 * want_total.max()
    quick_votes, quick_total = lifting._votes(splats, mask, all_count, view, 0.01, "cpu")
    np.testing.assert_allclose(quick_votes, votes, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(quick_total, total, rtol=1e-3, atol=1e-3)


def composited(alpha, depth):
    """(N, H, W) share of each splat, front to back."""
    order = np.argsort(depth, axis=0)
    sorted_alpha = np.take_along_axis(alpha, order, axis=0)
    through = np.cumprod(np.concatenate([np.ones_like(alpha[:1]), 1 - sorted_alpha[:-1]]), axis=0)
    weight = np.empty_like(alpha)
    np.put_along_axis(weight, order, sorted_alpha * through, axis=0)
    return weight


def rays_through_discs(splats, view):
    """Weights of discs, each met where the pixel's ray crosses its plane; sorted by their centres,
    as a splatter does."""
    rays = view.directions() @ view.rotation
    place, axes = splats.world_means(), splats.rotations().numpy()
    alpha = np.zeros((len(splats), *rays.shape[:2]))
    for i, (p, R, s, o) in enumerate(
        zip(place, axes, splats.scales.numpy(), splats.opacities.numpy(), strict=True)
    ):
        t = ((p - view.position) @ R[:, 2]) / (rays @ R[:, 2])
        local = (view.position + t[..., None] * rays - p) @ R[:, :2] / s
        alpha[i] = np.where(t > 0, o * np.exp(-0.5 * (local**2).sum(-1)), 0)
    depth = ((place - view.position) @ view.rotation.T)[:, 2]
    return composited(alpha, np.broadcast_to(depth[:, None, None], alpha.shape))


def projected_ellipsoids(splats, view):
    """Weights of ellipsoids by the EWA projection at their centres, which defines 3DGS."""
    place = (splats.world_means() - view.position) @ view.rotation.T
    axes = view.rotation @ (splats.rotations() * splats.scales[:, None]).numpy()
    xy = view.pixel_centers()
    f, alpha = view.K[0, 0], np.zeros((len(splats), view.height, view.width))
    for i, ((x, y, z), A, o) in enumerate(zip(place, axes, splats.opacities.numpy(), strict=True)):
        J = np.array([[f / z, 0, -f * x / z**2], [0, f / z, -f * y / z**2]])
        S = J @ A @ A.T @ J.T + splats.screen_filter * np.eye(2)
        d = xy - [f * x / z + view.K[0, 2], f * y / z + view.K[1, 2]]
        alpha[i] = o * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(S), d))
    return composited(alpha, np.broadcast_to(place[:, 2, None, None], alpha.shape))


def test_memberships_are_the_dense_solution_of_votes_and_ties():
    scene = ball_on_plane().select(torch.arange(0, 5100, 17))
    rng = np.random.default_rng(0)
    vote, trust = rng.uniform(size=300), np.where(rng.uniform(size=300) < 0.2, 30.0, 0.0)
    mine, reached = lifting._settled(scene, vote, trust)
    place, normal = scene.world_means(), scene.normals().numpy().astype(float)
    gap = np.linalg.norm(place[:, None] - place[None], axis=-1)
    ranked = np.argsort(gap, axis=1)[:, 1 : lifting.NEIGHBORS + 1]
    reach = np.median(np.take_along_axis(gap, ranked, axis=1), axis=1)
    tie = np.zeros((300, 300))
    for i in range(300):
        for j in ranked[i]:
            bend = 1 - (normal[i] @ normal[j]) ** 2
            near = gap[i, j] ** 2 / (reach[i] * reach[j])
            strength = np.exp(-near / 2 - bend / (2 * lifting.NORMAL_SPREAD**2))
            tie[i, j] = tie[j, i] = max(tie[i, j], tie[j, i], strength)
    held = np.where(reached, trust, 1.0)
    want = np.linalg.solve(np.diag(tie.sum(1) + held) - tie, held * np.where(reached, vote, 0))
    np.testing.assert_allclose(mine, np.where(reached, want, 0), atol=0.02)


def test_splats_tied_to_none_that_is_seen_are_left_out():
    scene = ball_on_plane()
    far = discs(np.random.default_rng(1).normal(size=(40, 3)) * 0.1 + [0, 0, 60], [[0, 0, 1.0]] * 40,
                0.05, [0.5, 0.5, 0.5])  # fmt: skip
    view = camera((3, 0, 1.0))
    lifted = lift_masks(joined(scene, far), [view], [np.ones((96, 96), dtype=bool)])
    assert not lifted.reached[BALL + 3600 :].any() and not lifted.membership[BALL + 3600 :].any()
    assert (
        lifted.membership[: BALL + 3600].min() > 0.99
    )  # everything: all that is tied to what is seen


@pytest.mark.parametrize("copies", [10, 40])
def test_splats_at_one_place_belong_to_what_lies_around_them(copies):
    """Copies of the ball's top, of its back, which the view does not see, and of the plane's
    corner."""
    scene, view = ball_on_plane(), camera((3, 0, 1.0))
    back = int(scene.means[:BALL, 0].argmin())
    again = scene.select(torch.tensor([0, back, BALL]).repeat_interleave(copies))
    lifted = lift_masks(joined(scene, again), [view], [ball_mask(view)])
    assert lifted.reached.all()
    top, hidden, corner = lifted.membership[len(scene) :].reshape(3, copies)
    assert top.min() > 0.9 and hidden.min() > 0.5 and corner.max() < 0.1
    heap = scene.select(torch.zeros(copies, dtype=torch.long))
    assert (lift_masks(heap, [view], [np.ones((96, 96))]).membership > 0.99).all()


def test_the_scale_of_a_scene_changes_no_mask():
    """With a near plane of an absolute length a scene of centimetres would show nothing."""
    scene, view = ball_on_plane(), camera((3, 0, 1.0))
    small = replace(scene, means=scene.means * 1e-3, scales=scene.scales * 1e-3)
    pose = view.world_to_camera.copy()
    pose[:3, 3] *= 1e-3
    near = Camera(view.K, pose, view.width, view.height)
    mask = ball_mask(view)
    first, second = (lift_masks(s, [c], [mask]) for s, c in ((scene, view), (small, near)))
    # The solver ends at a residual of 1e-4.
    np.testing.assert_allclose(first.membership, second.membership, atol=0.05)
    at = (48.0, 48.0)
    assert (piece_around(scene, view, at) == piece_around(small, near, at)).mean() > 0.999


def test_masks_that_contradict_each_other_are_reported():
    scene, first, second = ball_on_plane(), camera((3, 0, 1.0)), camera((2.9, 0.7, 1.0))
    full, none = ball_mask(first), np.zeros((96, 96), dtype=bool)
    lifted = lift_masks(scene, [first, second], [full, none])
    assert lifted.disputed[:BALL].sum() > 300 and not lifted.disputed[BALL:].any()
    assert lifted.agreement[1] == 0 or lifted.agreement[0] < 0.9


def test_a_mask_of_another_size_marks_the_same():
    import cv2

    scene, view = ball_on_plane(), camera((3, 0, 1.0))
    large = ball_mask(view.resize(288, 288))
    small = cv2.resize(large.astype(np.float32), (96, 96), interpolation=cv2.INTER_AREA)
    first, second = (lift_masks(scene, [view], [m]).render(view) > 0.5 for m in (large, small))
    assert not ((first != second) & ~near_edge(first, 1)).any()


def test_an_empty_mask_marks_nothing():
    scene, view = ball_on_plane(), camera((3, 0, 1.0))
    lifted = lift_masks(scene, [view], [np.zeros((96, 96), dtype=bool)])
    assert not lifted.membership.any() and np.isnan(lifted.agreement[0])
    assert not lifted.render(view).any()


@pytest.mark.parametrize(
    "mask, message",
    [
        (np.zeros((96, 60), dtype=bool), "masks\\[0\\].*aspect ratio"),
        (np.full((96, 96), 2.0), "masks\\[0\\]: got values to 2"),
        (np.zeros((96, 96), dtype=np.uint8), "masks\\[0\\]: got uint8"),
    ],
)
def test_masks_that_fit_no_view_are_refused_by_name(mask, message):
    with pytest.raises(ValueError, match=message):
        lift_masks(ball_on_plane(), [camera((3, 0, 1.0))], [mask])


def test_each_mask_needs_its_camera():
    with pytest.raises(ValueError, match="cameras: got 1, expected 2"):
        lift_masks(ball_on_plane(), [camera((3, 0, 1.0))], [np.zeros((96, 96), dtype=bool)] * 2)
    with pytest.raises(ValueError, match="masks: got none"):
        lift_masks(ball_on_plane(), [], [])


def test_pixels_that_are_not_kept_have_no_vote():
    """Oracle: a patch of the plane, marked by mistake, whose surroundings are not marked."""
    scene, view = ball_on_plane(), camera((0, -3, 2))
    ball, patch = ball_mask(view), np.zeros((96, 96), dtype=bool)
    patch[74:84, 42:54] = True
    assert not (patch & ball).any()

    def share(kept):
        lifted = lift_masks(scene, [view], [ball | patch], kept=kept)
        return float(lifted.render(view)[77:81, 45:51].mean())

    assert share(None) > 0.5 > 0.1 > share([~patch])
