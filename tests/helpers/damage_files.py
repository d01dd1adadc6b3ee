"""Seeded damage to files, and what a reader makes of it within a limit of time and memory.

A mutation depends on the original and the seed alone, so a failure is repeated by its seed. ::

    damaged = mutate_bytes(original, seed=17)
    outcomes = survey(cases, read, refusals=(ValueError,))
    assert not [o for o in outcomes if o.failed]
"""

from __future__ import annotations

import faulthandler
import json
import os
import random
import re
import resource
import select
import signal
import struct
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

SECONDS = 10.0
"""Longest time for one input."""

MEMORY = 1 << 30
"""Largest growth of the address space for one input, in bytes."""


def seeds_of(few, many):
    """Parametrise a test by ``seeds``: a few, and many more that are slow."""
    more = pytest.param(range(few, few + many), marks=pytest.mark.slow)
    return pytest.mark.parametrize("seeds", [range(few), more], ids=["few", "many"])


NUMBERS = (
    "0", "-0.0", "-1", "1", "255", "256", "65536", "-2147483649", "4294967296", "1e-320", "1e39",
    "-1e308", "1e999", "nan", "NaN", "-inf", "Infinity", "0x10", "1_000", "9" * 30, "7" * 5000,
)  # fmt: skip
"""Replacements for a number of a text: ends of types, values that are not finite, other
spellings.
"""

WORDS = (
    "true", "false", "null", "[]", "{}", '"text"', '"3.5"', "''", "~", "[[[[", "]]]]", "{{", "}}",
    ":", ",", "-", "#", "&a", "*a", "!!int 'x'", "../../outside", "\\u0000", "é", "\t", "\r\n",
)  # fmt: skip
"""Words put in place of a token or between two tokens of a text."""

PATCHES = (
    b"\x00" * 4, b"\xff" * 4, b"\x00" * 8, b"\xff" * 8, struct.pack("<f", float("nan")),
    struct.pack("<f", float("inf")), struct.pack("<d", 1e300), struct.pack("<I", 1 << 31),
    struct.pack("<Q", 1 << 40), b"\n", b" ", b"\r\n", b"end_header\n", b"PK\x03\x04",
)  # fmt: skip
"""Bytes that overwrite those of a file, or are put between them."""


def mutate_bytes(data: bytes, seed: int) -> bytes:
    """``data`` with one to three mutations: bits flipped, runs removed, doubled, moved,
    overwritten or inserted, or an end that is missing.

    Example:
        >>> mutate_bytes(b"0123456789", 1) == mutate_bytes(b"0123456789", 1)
        True
        >>> mutate_bytes(b"0123456789", 1) == b"0123456789"
        False
    """
    rng = random.Random(f"bytes {seed}")
    result = data
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        result = rng.choice(_BYTES)(result, rng)
    return result if result != data else data[: len(data) // 2] + b"\x00" + data[len(data) // 2 :]


def mutate_text(text: str, seed: int) -> str:
    """``text`` with one to three mutations that leave most of it a text of its kind.

    Numbers become others, tokens become words of another type, lines are removed, doubled or
    swapped, and brackets are nested deeply.

    Example:
        >>> mutate_text('{"a": 1}', 3) == mutate_text('{"a": 1}', 3)
        True
    """
    rng = random.Random(f"text {seed}")
    result = text
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        result = rng.choice(_TEXT)(result, rng)
    return result if result != text else text[: len(text) // 2]


def _place(data: bytes | str, rng: random.Random) -> int:
    # Half of them near the beginning, where headers and counts stand.
    return (
        rng.randrange(min(len(data), 400) + 1)
        if rng.random() < 0.5
        else rng.randrange(len(data) + 1)
    )


def _flip(data: bytes, rng: random.Random) -> bytes:
    if not data:
        return b"\x00"
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[min(_place(data, rng), len(data) - 1)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start = _place(data, rng)
    return data[:start] + data[start + rng.choice((1, 3, 4, 16, 61, 200)) :]


def _insert(data: bytes, rng: random.Random) -> bytes:
    start = _place(data, rng)
    patch = rng.choice((*PATCHES, rng.randbytes(rng.choice((1, 3, 4, 16, 61, 200)))))
    return data[:start] + patch + data[start:]


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    start, patch = _place(data, rng), rng.choice(PATCHES)
    return data[:start] + patch + data[start + len(patch) :]


def _double(data: bytes, rng: random.Random) -> bytes:
    start, length = _place(data, rng), rng.choice((1, 4, 61, 500))
    return data[:start] + data[start : start + length] + data[start:]


def _move(data: bytes, rng: random.Random) -> bytes:
    start, length = _place(data, rng), rng.choice((4, 16, 61))
    run, rest = data[start : start + length], data[:start] + data[start + length :]
    end = _place(rest, rng)
    return rest[:end] + run + rest[end:]


_BYTES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip, _flip, _cut, _remove, _insert, _overwrite, _double, _move,
)  # fmt: skip

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_TOKEN = re.compile(r"[\w.+-]+|\"[^\"\n]*\"|[\[\]{}:,]")


def _replace(text: str, pattern: re.Pattern[str], words: Sequence[str], rng: random.Random) -> str:
    matches = list(pattern.finditer(text))
    if not matches:
        return text + rng.choice(words)
    match = rng.choice(matches)
    return text[: match.start()] + rng.choice(words) + text[match.end() :]


def _number(text: str, rng: random.Random) -> str:
    return _replace(text, _NUMBER, NUMBERS, rng)


def _retype(text: str, rng: random.Random) -> str:
    return _replace(text, _NUMBER, WORDS, rng)


def _token(text: str, rng: random.Random) -> str:
    return _replace(text, _TOKEN, WORDS, rng)


def _squeeze(text: str, rng: random.Random) -> str:
    start = _place(text, rng)
    return text[:start] + rng.choice(WORDS) + text[start:]


def _lines(text: str, rng: random.Random) -> str:
    lines = text.splitlines(keepends=True)
    if len(lines) < 2:
        return text[: rng.randrange(len(text) + 1)]
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[i]
        case 1:
            lines.insert(j, lines[i])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
        case _:
            lines = lines[: i + 1]
    return "".join(lines)


def _nest(text: str, rng: random.Random) -> str:
    opening, closing = rng.choice((("[", "]"), ("{a: ", "}"), ('{"a": ', "}")))
    depth = rng.choice((3, 300, 20_000))
    return _replace(text, _NUMBER, (opening * depth + "1" + closing * depth,), rng)


def _clip(text: str, rng: random.Random) -> str:
    return text[: rng.randrange(len(text) + 1)]


_TEXT: tuple[Callable[[str, random.Random], str], ...] = (
    _number, _number, _retype, _token, _squeeze, _lines, _lines, _nest, _clip,
)  # fmt: skip


# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """Outcome of one input.

    Attributes:
        case: its label, such as "ply 17", by which it is made again.
        kind: "result"; "refused", by an expected exception with one line; "error", any other
            exception or more than one line; "crash"; "time"; "memory".
        detail: the message, the traceback or the signal.
    """

    case: str
    kind: str
    detail: str = ""

    @property
    def failed(self) -> bool:
        """True if it is neither a result nor a refusal in one line."""
        return self.kind not in ("result", "refused")


def failures(
    name: str,
    whole: bytes,
    read: Callable[[Any], object],
    seeds: Sequence[int],
    *,
    refusals: tuple[type[BaseException], ...],
    text: bool = False,
) -> list[str]:
    """Failures of damaged copies of a file, each by its label: the name and the seed.

    Args:
        name: of the file or of its format.
        whole: the undamaged file.
        read: see :func:`survey`.
        seeds: one for each copy.
        refusals: see :func:`survey`; at least one copy must be refused.
        text: whether every second copy is damaged as a text.
    """

    def damaged(seed: int) -> bytes:
        if text and seed % 2:
            return mutate_text(whole.decode(), seed).encode("utf-8", "surrogatepass")
        return mutate_bytes(whole, seed)

    cases = [(f"{name} {seed}", damaged(seed)) for seed in seeds]
    outcomes = survey(cases, read, refusals=refusals)
    assert len(outcomes) == len(cases)
    assert any(o.kind == "refused" for o in outcomes), "the damage reaches the reader"
    return [f"{o.case}: {o.kind}\n{o.detail}" for o in outcomes if o.failed]


def survey(
    cases: Iterable[tuple[str, object]],
    read: Callable[[object], object],
    *,
    refusals: tuple[type[BaseException], ...],
    seconds: float = SECONDS,
    memory: int = MEMORY,
) -> list[Outcome]:
    """Call ``read`` on each input, in a child process that a crash may end.

    Args:
        cases: labels and inputs.
        read: what is tested; it raises AssertionError where the result is wrong.
        refusals: the exceptions that say in one line what is wrong with the input.
        seconds, memory: limits for each.
    """
    waiting, outcomes = list(cases), []
    while waiting:
        done = _child(waiting, read, refusals, seconds, memory)
        outcomes += done
        waiting = waiting[len(done) :]
    return outcomes


def _child(
    cases: Sequence[tuple[str, object]],
    read: Callable[[object], object],
    refusals: tuple[type[BaseException], ...],
    seconds: float,
    memory: int,
) -> list[Outcome]:
    """The outcomes up to the end of the cases, or to the first that took the child along."""
    receiving, sending = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receiving)
        faulthandler.disable()  # a crash is reported as an outcome
        try:
            _limit(memory)
            with os.fdopen(sending, "w") as stream:
                for label, given in cases:
                    stream.write(json.dumps(_one(label, given, read, refusals)) + "\n")
                    stream.flush()
        finally:
            os._exit(0)
    os.close(sending)
    outcomes: list[Outcome] = []
    text, late = b"", False
    started = time.monotonic()
    while True:
        ready, _, _ = select.select(
            [receiving], [], [], max(0.0, seconds + started - time.monotonic())
        )
        if not ready:
            late = True
            os.kill(child, signal.SIGKILL)
            break
        chunk = os.read(receiving, 1 << 16)
        if not chunk:
            break
        text += chunk
        *lines, text = text.split(b"\n")
        outcomes += [Outcome(*json.loads(line)) for line in lines]
        if lines:
            started = time.monotonic()
    os.close(receiving)
    _, status = os.waitpid(child, 0)
    if len(outcomes) < len(cases):
        label = cases[len(outcomes)][0]
        if late:
            outcomes.append(Outcome(label, "time", f"more than {seconds:g} s"))
        else:
            outcomes.append(Outcome(label, "crash", f"ended with status {status}"))
    return outcomes


def _limit(memory: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    used = pages * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + memory, hard))


def _one(
    label: str,
    given: object,
    read: Callable[[object], object],
    refusals: tuple[type[BaseException], ...],
) -> tuple[str, str, str]:
    try:
        read(given)
    except AssertionError:
        return label, "error", traceback.format_exc()
    except refusals as error:
        message = str(error)
        if not message.strip() or "\n" in message.strip():
            return label, "error", f"not one line: {message}"
        return label, "refused", message
    except MemoryError:
        return label, "memory", traceback.format_exc()
    except BaseException:
        return label, "error", traceback.format_exc()
    return label, "result", ""
