"""The helper that damages files: it repeats by its seed, and sees every way to fail."""

import os
import signal
import time

import pytest
from damage_files import mutate_bytes, mutate_text, survey

TEXT = '{\n  "w": 8,\n  "frames": [{"file_path": "a.png", "k1": -1.5e-3}]\n}\n'


def test_a_mutation_repeats_by_its_seed_and_changes_something():
    data = bytes(range(256)) * 4
    for seed in range(200):
        assert mutate_bytes(data, seed) == mutate_bytes(data, seed) != data
        assert mutate_text(TEXT, seed) == mutate_text(TEXT, seed) != TEXT
    assert len({mutate_bytes(data, seed) for seed in range(200)}) > 190
    assert len({mutate_text(TEXT, seed) for seed in range(200)}) > 100


def test_nothing_is_too_short_to_be_mutated():
    for seed in range(50):
        mutate_bytes(b"", seed)
        mutate_text("", seed)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # fork beside threads of libraries
def test_every_way_to_fail_is_seen_and_the_rest_goes_on():
    def read(case):
        match case:
            case "refused":
                raise ValueError("no")
            case "two lines":
                raise ValueError("no\nno")
            case "other":
                raise KeyError("no")
            case "wrong":
                raise AssertionError("no")
            case "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "hang":
                time.sleep(60)
            case "memory":
                return b"x" * (3 << 30)

    names = ["fine", "refused", "two lines", "other", "wrong", "crash", "hang", "memory", "fine"]
    outcomes = survey([(n, n) for n in names], read, refusals=(ValueError,), seconds=1)
    assert [o.case for o in outcomes] == names
    assert [o.kind for o in outcomes] == [
        "result", "refused", "error", "error", "error", "crash", "time", "memory", "result",
    ]  # fmt: skip
    assert [o.failed for o in outcomes] == [n not in ("fine", "refused") for n in names]
