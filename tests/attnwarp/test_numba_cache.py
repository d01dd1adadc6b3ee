"""Oracles: the file system, and a render where nothing can be written."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from attnwarp import numba_cache

ROOT = Path(__file__).parents[2]

RENDER = """
import torch
from attnwarp import Camera, Gaussians
from attnwarp.numba_cache import kernel_folder
from attnwarp.render import render

disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
                 torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
camera = Camera.look_at((0, 0, 3), (0, 0, 0), width=16, height=16, fov_y=40, up=(0, 1, 0))
print(kernel_folder(), round(float(render(disc, camera).alpha.max()), 4))
"""


def deny(monkeypatch, *folders):
    """Forbid writing to folders, as to root nothing is."""
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: Path(path) not in folders and access(path, mode)
    )


def test_kernels_lie_beside_their_modules_where_these_can_be_written(monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert os.access(numba_cache.HERE, os.W_OK) and numba_cache.kernel_folder() is None


def test_of_another_users_installation_kernels_lie_in_the_own_cache(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path / "own"))
    deny(monkeypatch, numba_cache.HERE)
    assert numba_cache.kernel_folder() == tmp_path / "own" / "numba"
    assert (tmp_path / "own" / "numba").stat().st_mode & 0o077 == 0


def test_a_cache_that_cannot_be_written_is_left_for_a_temporary_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("ATTNWARP_CACHE", "/proc/none")
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    deny(monkeypatch, numba_cache.HERE)
    own = tmp_path / f"attnwarp-{os.getuid()}-numba"
    assert numba_cache.kernel_folder() == own
    # A folder that somebody else made in a shared place holds code of theirs.
    monkeypatch.setattr("os.getuid", lambda: own.stat().st_uid + 1)
    (tmp_path / f"attnwarp-{os.getuid()}-numba").mkdir()
    assert numba_cache.kernel_folder() is None


def test_warp_takes_no_folder_of_another_user_either(monkeypatch, tmp_path):
    gpu = pytest.importorskip("attnwarp.render.gpu", exc_type=ImportError)
    monkeypatch.delenv("WARP_CACHE_PATH", raising=False)
    monkeypatch.setenv("ATTNWARP_CACHE", "/proc/none")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home" / ".cache").mkdir(parents=True)
    deny(monkeypatch, tmp_path / "home" / ".cache")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("os.getuid", lambda: tmp_path.stat().st_uid + 1)
    theirs = tmp_path / f"attnwarp-{os.getuid()}-warp"
    theirs.mkdir()
    chosen = Path(gpu._cache_folder())
    assert chosen.parent == tmp_path and chosen != theirs


@pytest.mark.slow
def test_a_read_only_installation_without_a_home_renders(tmp_path):
    mounted = f"mount --bind {ROOT} {ROOT} && mount -o remount,ro,bind {ROOT}"
    if subprocess.run(["unshare", "-m", "sh", "-c", mounted], capture_output=True).returncode:
        pytest.skip("mounting needs root")
    (tmp_path / "render.py").write_text(RENDER)
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    called = (
        f"cd {tmp_path} && env -i HOME=/proc/none TMPDIR={temporary} {sys.executable} render.py"
    )
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", f"{mounted} && {called}"], capture_output=True, text=True
    )
    # The nearest pixel lies half a pixel off the disc's centre in both directions.
    offset = 3 * math.tan(math.radians(20)) / 16 / 0.5
    expected = [f"{temporary}/attnwarp-{os.getuid()}-numba", f"{math.exp(-(offset**2)):.4f}"]
    assert done.stdout.split() == expected, done.stderr
