"""Needs of photographs: masks, exposure, views that choose. Oracles: the pictures' makers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_scenes import cameras, pictures, splats

from attnwarp import losses
from attnwarp.fit import FitSettings, Views, beside_mean_color, fit, from_points, say_unlike
from attnwarp.fit.loop import SPLATS
from attnwarp.io import read_ply
from attnwarp.render import render
from attnwarp.reporting import Reporter

from .conftest import blobs, ring
from .conftest import pictures as shown_by

FAST = {
    "sh_degree": 0, "densify": False, "lr_means": 1e-3, "lr_dc": 2e-2, "lr_opacity": 0.2,
    "lr_scales": 2e-2, "kind": "3d",
}  # fmt: skip


def begin(scene):
    return from_points(scene[2], scene[3], kind="3d", sh_degree=0)


def test_what_a_mask_ignores_changes_no_bit(scene):
    def masked(value, views):
        images = [image.copy() for image in views.images]
        masks = []
        for k, image in enumerate(images):
            mask = np.ones(image.shape[:2], bool)
            mask[4 + k : 14 + k, 8:20] = False
            image[~mask] = value
            masks.append(mask)
        return Views(views.cameras, images, masks)

    settings = FitSettings(iterations=20, evaluate_every=10, **FAST)
    one, other = (
        fit(begin(scene), masked(value, scene[0]), settings, held_out=masked(value, scene[1]))
        for value in (0.0, 1.0)
    )
    assert torch.equal(one.gaussians.means, other.gaussians.means)
    assert torch.equal(one.gaussians.sh, other.gaussians.sh)
    assert one.history[-1].psnr == other.history[-1].psnr
    assert one.history[-1].psnr > one.history[0].psnr


def test_exposure_takes_what_is_a_pictures_own(scene):
    """Pictures made brighter and darker by turns: the splats have the mean colour."""
    gains = [0.3 if k % 2 else 1.0 for k in range(len(scene[0]))]
    shot = Views(scene[0].cameras, [i * g for i, g in zip(scene[0].images, gains, strict=True)])
    middle = Views(scene[1].cameras, [0.65 * image for image in scene[1].images])
    psnr = [
        fit(
            begin(scene), shot, FitSettings(iterations=100, exposure=exposure, **FAST),
            held_out=middle,
        ).kept.psnr
        for exposure in (False, True)
    ]  # fmt: skip
    assert psnr[1] > psnr[0] + 0.5


def test_views_that_choose_are_not_those_that_are_reported(scene):
    """The choosing views are black: the first splats, which show least, are the nearest to them."""
    cameras = [scene[1].cameras[0], *scene[0].cameras[:3]]
    held_out = Views(cameras, [scene[1].images[0], *[np.zeros_like(scene[1].images[1])] * 3])
    shown = Views(scene[0].cameras[3:], scene[0].images[3:])
    settings = FitSettings(iterations=60, evaluate_every=20, patience=5, **FAST)
    start = begin(scene)
    result = fit(start, shown, settings, held_out=held_out)
    assert (result.kept.iteration, result.iteration) == (0, 60)
    torch.testing.assert_close(result.gaussians.sh, start.sh)
    seen = render(start, cameras[0], sh_degree=0, near=0.01 * result.extent).color.clamp(0, 1)
    picture = torch.from_numpy(np.asarray(held_out.images[0], np.float32))
    assert result.kept.psnr == pytest.approx(float(losses.psnr(seen, picture)), abs=1e-3)
    # One view fewer leaves too few to choose by.
    few = Views(held_out.cameras[:3], held_out.images[:3])
    result = fit(start, shown, settings, held_out=few)
    assert (result.kept.iteration, result.kept.choosing) == (60, None)


@pytest.mark.parametrize("outlier", [0.0, None])
def test_an_outlier_among_the_views_that_choose_leaves_a_fit_of_60_views_its_splats(outlier):
    """One choosing picture is black, or noise: the mean of PSNR falls as the fit goes on."""
    truth, cameras = blobs(), ring(60, size=24)
    images = list(shown_by(truth, cameras).images)
    noise = np.random.default_rng(0).random(images[8].shape, np.float32)
    images[8] = noise if outlier is None else np.full_like(images[8], outlier)
    parts = [
        Views([c for k, c in enumerate(cameras) if bool(k % 8) == fitted],
              [i for k, i in enumerate(images) if bool(k % 8) == fitted])
        for fitted in (True, False)
    ]  # fmt: skip
    points = truth.world_means()[::2]
    start = from_points(points, kind="3d", sh_degree=0)
    settings = FitSettings(
        iterations=300, evaluate_every=30, patience=2, grow_gradient=1e-5, max_splats=60,
        **{**FAST, "densify": True},
    )  # fmt: skip
    result = fit(start, parts[0], settings, held_out=parts[1])
    assert result.kept.iteration >= 150 and len(result.gaussians) > len(start)
    first, *_, last = result.history
    assert last.psnr > first.psnr + 3 and result.kept.psnr > last.psnr - 0.5


def test_splats_that_no_picture_shows_are_removed(scene):
    start = begin(scene)
    far = replace(start.select(torch.tensor([0])), means=torch.tensor([[0.0, 0.0, 50.0]]))
    both = replace(
        start,
        **{
            name: torch.cat([getattr(start, name), getattr(far, name)])
            for name in ("means", "quats", "scales", "opacities", "sh")
        },
    )
    settings = FitSettings(iterations=1, **{**FAST, "densify": True})
    assert len(fit(both, scene[0], settings).gaussians) == len(start)


def test_splats_are_there_while_a_fit_runs(scene, tmp_path):
    class Killed(Reporter):
        def step(self, done, total, text, left=None):
            if done == 3:
                raise KeyboardInterrupt

    settings = FitSettings(iterations=9, **FAST)
    with pytest.raises(KeyboardInterrupt):
        fit(
            begin(scene), scene[0], settings, folder=tmp_path, checkpoint_seconds=0, report=Killed()
        )
    assert len(read_ply(tmp_path / SPLATS)) == len(begin(scene))


def test_splats_that_explain_less_than_half_of_their_pictures_are_told_as_such():
    """Oracle: renders of the splats, of which each is blended with noise of a known variance."""
    model, views = splats(), cameras()
    shown, noise = pictures(model, views), np.random.default_rng(0)

    def said(share):
        blended = [
            (1 - share) * image + share * noise.random(image.shape, np.float32) for image in shown
        ]
        psnr, plain = beside_mean_color(model, Views(views, blended))
        error = np.mean([np.square(b - i).mean() for b, i in zip(blended, shown, strict=True)])
        spread = np.mean([b.var(axis=(0, 1)).mean() for b in blended])
        assert (psnr, plain) == pytest.approx(-10 * np.log10([error, spread]), abs=1e-3)
        assert bool(say_unlike(psnr, plain)) == (error > spread / 2)
        return say_unlike(psnr, plain)

    assert not said(0.05)
    assert "check that the cameras' poses belong to the pictures" in said(0.9)
