"""The memory that the renderer uses again must never be memory that somebody still holds."""

from __future__ import annotations

import gc

import numpy as np
import torch

from attnwarp.render import _pool


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


def test_nearby_sizes_share_blocks_and_no_more_than_the_bound_is_held(monkeypatch) -> None:
    _pool.clear()
    place = _pool.empty(1_000_000, np.uint8).ctypes.data
    assert _pool.empty(995_000, np.uint8).ctypes.data == place
    monkeypatch.setattr(_pool, "MOST", 3_000_000)
    arrays = [_pool.empty(1_000_000, np.uint8) for _ in range(8)]
    del arrays
    assert sum(raw.nbytes for raws in _pool._free.values() for raw in raws) <= 3_000_000


def test_shapes_types_and_small_arrays() -> None:
    for shape in ((), 0, 3, (0, 5), (7, 11), (70, 1100)):
        for dtype in (np.float32, np.int64, np.uint8):
            array = _pool.zeros(shape, dtype)
            assert array.shape == np.zeros(shape).shape and array.dtype == dtype and not array.any()
            assert array.flags.c_contiguous and array.flags.writeable


def test_a_block_beyond_the_bound_is_not_held(monkeypatch) -> None:
    monkeypatch.setattr(_pool, "MOST", 1 << 20)
    _pool.clear()
    del_me = _pool.empty((1 << 21,), np.uint8)
    del del_me
    assert _pool._held == 0
