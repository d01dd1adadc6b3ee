"""The memory that the renderer uses again must never be memory that somebody still holds."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
import torch

from attnwarp.render import _pool
from attnwarp.render.api import render


def test_a_block_is_used_again_once_nobody_holds_it_and_not_before() -> None:
    _pool.clear()
    first = _pool.empty((100, 100), np.float32)
    place = first.ctypes.data
    assert place % _pool.ALIGNMENT == 0
    part = first[10:20]
    del first
    gc.collect()
    other = _pool.empty((100, 100), np.float32)
    assert other.ctypes.data != place  # a view holds it
    del part
    assert _pool.empty((100, 100), np.float32).ctypes.data == place


def test_a_tensor_made_of_it_keeps_it() -> None:
    _pool.clear()
    array = _pool.zeros((64, 128), np.float32)
    tensor = torch.from_numpy(array)[3:4].clone().copy_(torch.from_numpy(array)[3:4])
    kept = torch.from_numpy(array).view(-1)[5:]
    del array
    gc.collect()
    for _ in range(3):
        _pool.empty((64, 128), np.float32).fill(7)
    assert float(kept.abs().max()) == 0 and float(tensor.abs().max()) == 0


def test_nearby_sizes_share_blocks() -> None:
    _pool.clear()
    place = _pool.empty(1_000_000, np.uint8).ctypes.data
    assert _pool.empty(995_000, np.uint8).ctypes.data == place


def test_shapes_types_and_small_arrays() -> None:
    for shape in ((), 0, 3, (0, 5), (7, 11), (70, 1100)):
        for dtype in (np.float32, np.int64, np.uint8):
            array = _pool.zeros(shape, dtype)
            assert array.shape == np.zeros(shape).shape and array.dtype == dtype and not array.any()
            assert array.flags.c_contiguous and array.flags.writeable


MIB = 1 << 20


@pytest.fixture
def traced(monkeypatch) -> Iterator[Callable[[], tuple[int, int]]]:
    """Python's own count of allocated bytes: those held, and their peak since the call before.

    It begins with a window of its own: a need is forgotten by the arrays taken since, and those of
    other tests would decide where.
    """
    monkeypatch.setattr(_pool, "_taken", 0)
    monkeypatch.setattr(_pool, "_need", [0, 0])
    _pool.clear()
    gc.collect()
    tracemalloc.start()
    start = tracemalloc.get_traced_memory()[0]

    def read() -> tuple[int, int]:
        gc.collect()
        now, peak = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        return now - start, peak - start

    yield read
    tracemalloc.stop()
    _pool.clear()


def view(sizes: Sequence[int]) -> None:
    """Take arrays of these sizes at one time, and return them. No page of them is touched."""
    del [_pool.empty(size, np.uint8) for size in sizes][:]


def test_a_view_that_needs_a_gigabyte_takes_no_fresh_memory_the_second_time(traced) -> None:
    sizes = [100 * MIB] * 7 + [300 * MIB]
    view(sizes)
    first, peak = traced()
    assert 1000 * MIB <= first <= peak <= 1.01 * 1000 * MIB + 64 * MIB
    view(sizes)
    assert traced()[1] - first < MIB


def test_a_picture_drawn_again_takes_fresh_memory_for_itself_alone(
    traced, monkeypatch, make_camera, make_splats
) -> None:
    monkeypatch.setattr(_pool, "LEAST", MIB)
    camera = make_camera(0, 256, 256)
    splats = make_splats(0, "3d", 20_000, camera).to(torch.float32)
    with torch.no_grad():
        for _ in range(2):
            render(splats, camera, backend="cpu")
        before, peak = traced()
        assert peak > 8 * MIB  # far above the least
        render(splats, camera, backend="cpu")
    assert traced()[1] - before < MIB


def test_small_views_after_a_big_one_give_its_memory_back(traced) -> None:
    view([100 * MIB] * 10)
    for _ in range(2 * _pool.WINDOW):
        view([MIB])
    assert traced()[0] < 2 * MIB + 256 * MIB


def test_views_of_changing_sizes_hold_little_more_than_one_of_them_needs(traced) -> None:
    for size in range(100, 200, 5):
        view([size * MIB] * 5)
    assert traced()[1] < 1.25 * 5 * 1.13 * 200 * MIB  # blocks are up to an eighth larger


def test_pictures_kept_and_dropped_are_not_held_for_a_view(traced) -> None:
    kept = []
    for _ in range(2000):
        kept.append(_pool.empty(MIB, np.uint8))
        view([MIB] * 4)
    assert traced()[0] > 2000 * MIB
    del kept
    assert traced()[0] < 2 * 256 * MIB
