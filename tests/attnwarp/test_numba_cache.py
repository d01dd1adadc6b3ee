"""Oracles: the file system, and a render where nothing can be written."""

import ast
import importlib.util
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from attnwarp import numba_cache
from attnwarp.render._kernels import (
    backward,
    binning,
    ordering,
    projection,
    projection_backward,
    rasterization,
)

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


def test_a_change_in_any_module_throws_cached_code_away(tmp_path):
    """numba itself looks at the file of a function only, not at those of what was inlined into
    it."""
    sources = numba_cache.kernel_sources()
    for path in sources:
        copy = tmp_path / path.relative_to(numba_cache.HERE)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copy)
    assert numba_cache.kernel_key(tmp_path) == numba_cache.KEY
    keys = {numba_cache.KEY}
    for copy in numba_cache.kernel_sources(tmp_path):
        copy.write_text(copy.read_text() + "\n")
        keys.add(numba_cache.kernel_key(tmp_path))
    assert len(keys) == len(sources) + 1 > 15
    for dispatcher in (
        rasterization.rasterize,
        backward.rasterize_backward,
        projection.project,
        projection_backward.project_backward,
        ordering.depths,
        binning.find_runs,
    ):
        assert dispatcher._cache._cache_file._source_stamp == numba_cache.KEY


def test_the_key_covers_all_text_that_kernels_use():
    """A kernel uses names of its own module and, in a module of the key, of other such modules."""
    sources = numba_cache.kernel_sources()
    covered = {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in sources}
    checked = 0
    for path in [*ROOT.glob("attnwarp/**/*.py"), *ROOT.glob("eval/**/*.py")]:
        text = path.read_text()
        if "numba" not in text and path not in sources:
            continue
        tree = ast.parse(text)
        of = {
            alias.asname or alias.name: node.module
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("attnwarp")
            for alias in node.names
        }
        for function in ast.walk(tree):
            decorators = getattr(function, "decorator_list", [])
            if not any(word in ast.unparse(d) for d in decorators for word in ("jit", *COMPILERS)):
                continue
            checked += 1
            used = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
            others = {of[name] for name in used & of.keys()}
            assert others - {"attnwarp.numba_cache"} <= (covered if path in sources else set()), (
                path
            )
    assert checked > 100


COMPILERS = ("bare", "inlined", "exact", "exact_inlined", "exact_pasted", "intrinsic", "overload")


def test_checkouts_share_a_kernel_of_the_same_text_alone(monkeypatch, tmp_path):
    """Oracle: numba's own counts of what was compiled, and of what came from disk."""
    classes = "attnwarp.numba_cache.BySource,InTreeCacheLocator"
    monkeypatch.setenv("NUMBA_CACHE_LOCATOR_CLASSES", classes)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    numba.config.reload_config()

    def scaled(checkout, factor, key):
        monkeypatch.setattr(numba_cache, "KEY", key)
        path = tmp_path / checkout / "kernel.py"
        path.parent.mkdir()
        path.write_text(
            f"import numba\n\n@numba.njit(cache=True)\ndef f(x):\n    return {factor} * x\n"
        )
        spec = importlib.util.spec_from_file_location("attnwarp_of_a_test.kernel", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.f(1), sum(module.f.stats.cache_hits.values())

    assert scaled("first", 2, "a") == (2, 0)
    assert scaled("second", 2, "a") == (2, 1)
    assert scaled("own_text_changed", 3, "a") == (3, 0)
    assert scaled("others_text_changed", 2, "b") == (2, 0)


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
