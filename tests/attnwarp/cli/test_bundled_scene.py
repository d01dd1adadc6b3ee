"""Bundled captures. Oracles: the pictures themselves; scenes rendered and fitted anew."""

import numpy as np
import pytest

from attnwarp.cli.bundled_scene import FOLDER, SIZE, bundled, capture
from attnwarp.fit import load_views
from attnwarp.io import read_dataset, read_ply
from attnwarp.render import render
from attnwarp.reporting import SILENT
from scripts.bundle_scenes import made, round_splats


def psnr(a, b):
    return -10 * np.log10(np.square(a.astype(np.float64) - b).mean())


def fits(splats, views):
    """PSNR of renders, dB; no view of a capture is one of those fitted."""
    renders = [render(splats, camera).color.clamp(0, 1).numpy() for camera in views.cameras]
    return psnr(np.stack(renders), np.stack(views.images) / 255)


def read(folder):
    return load_views(read_dataset(folder))


def scenes(*names):
    first, *others = names
    return [first, *(pytest.param(name, marks=pytest.mark.door) for name in others)]


@pytest.mark.parametrize("name", scenes("bear", "dinosaur", "fence", "spheres"))
def test_bundled_splats_fit_pictures_that_no_fit_has_seen(name, tmp_path):
    capture(name, tmp_path, SILENT)
    views = read(tmp_path)
    assert len(views) == 24
    assert {(c.width, c.height) for c in views.cameras} == {(SIZE, SIZE)}
    # The mean colour of a picture reaches 15 dB.
    assert fits(read_ply(tmp_path / "splats.ply"), views) > 24


def test_bundled_captures_are_small():
    """4 MB in all, so that they may come with the package."""
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 4e6


@pytest.mark.slow
@pytest.mark.parametrize("name", bundled())
def test_a_bundled_capture_is_that_of_its_commands(name, tmp_path):
    capture(name, tmp_path / "bundled", SILENT)
    fresh = made(name, tmp_path)
    views, old = read(fresh), read(tmp_path / "bundled")
    for k, camera in enumerate(views.cameras):
        assert np.allclose(camera.world_to_camera, old.cameras[k].world_to_camera, atol=1e-9)
        # Variants of Mitsuba differ by the noise of 16 samples a pixel, and a JPEG by less.
        assert psnr(views.images[k] / 255, old.images[k] / 255) > 30
    for path in fresh.glob("masks/*/*.png"):
        assert path.read_bytes() == (tmp_path / "bundled" / path.relative_to(fresh)).read_bytes()
    round_splats(tmp_path / "fit" / "splats.ply", tmp_path / "rounded.ply")
    files = ("fit/splats.ply", "rounded.ply", "bundled/splats.ply")
    full, rounded, kept = (fits(read_ply(tmp_path / file), views) for file in files)
    # Half floats move a render by less than a level in the mean; two fits differ by noise.
    assert abs(rounded - full) < 0.05 and abs(kept - full) < 0.5
