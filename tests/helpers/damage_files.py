"""Damage as disks, downloads and editors do it, by seed, and what a reader makes of it.

A mutation depends on the original and the seed alone, so a failure is repeated by its seed. ::

    failed = failures("ply", whole, read, range(9), refusals=(InputError,))
    assert not failed, "\\n".join(failed)
"""

from __future__ import annotations

import random
import traceback
from collections.abc import Callable, Sequence

import pytest


def seeds_of(few, many):
    """Parametrise a test by ``seeds``: a few, and many more that are slow."""
    more = pytest.param(range(few, few + many), marks=pytest.mark.slow)
    return pytest.mark.parametrize("seeds", [range(few), more], ids=["few", "many"])


def mutate(data: bytes, seed: int, *, text: bool = False) -> bytes:
    """``data`` with some bits flipped, its end missing, or a run removed, doubled or zeroed; every
    second copy of a text with a line removed, doubled or moved.

    Example:
        >>> mutate(b"0123456789", 1) == mutate(b"0123456789", 1) != b"0123456789"
        True
    """
    rng = random.Random(seed)
    result = _lines(data, rng) if text and seed % 2 else rng.choice(_BYTES)(data, rng)
    return result if result != data else data[: len(data) // 2]


def _place(data: bytes, rng: random.Random) -> int:
    # Half of them near the beginning, where headers and counts stand.
    return rng.randrange(min(len(data), 400) if rng.random() < 0.5 else len(data))


def _run(data: bytes, rng: random.Random) -> slice:
    start = _place(data, rng)
    return slice(start, start + rng.choice((1, 3, 4, 16, 61, 200)))


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _remove(data: bytes, rng: random.Random) -> bytes:
    run = _run(data, rng)
    return data[: run.start] + data[run.stop :]


def _double(data: bytes, rng: random.Random) -> bytes:
    run = _run(data, rng)
    return data[: run.stop] + data[run.start :]


def _zero(data: bytes, rng: random.Random) -> bytes:
    run = _run(data, rng)
    return data[: run.start] + bytes(len(data[run])) + data[run.stop :]


_BYTES = (_flip, _flip, _cut, _remove, _double, _zero)


def _lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    line = lines.pop(rng.randrange(len(lines)))
    for _ in range(rng.randrange(3)):
        lines.insert(rng.randrange(len(lines) + 1), line)
    return b"".join(lines)


def failures(
    name: str,
    whole: bytes,
    read: Callable[[bytes], object],
    seeds: Sequence[int],
    *,
    refusals: tuple[type[BaseException], ...],
    text: bool = False,
) -> list[str]:
    """Failures of damaged copies of a file, each by its label: the name and the seed.

    Args:
        name: of the file or of its format.
        whole: the undamaged file.
        read: what is tested; it raises AssertionError where the result is wrong.
        seeds: one for each copy.
        refusals: exceptions that say in one line what is wrong; at least one copy must be refused.
        text: whether every second copy is damaged by its lines.
    """
    failed, refused = [], 0
    for seed in seeds:
        try:
            read(mutate(whole, seed, text=text))
        except refusals as error:
            refused += 1
            if len(str(error).strip().splitlines()) != 1:
                failed.append(f"{name} {seed}: not one line: {error}")
        except Exception:
            failed.append(f"{name} {seed}:\n{traceback.format_exc()}")
    assert refused, "the damage reaches the reader"
    return failed
