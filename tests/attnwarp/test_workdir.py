"""A checkpoint is what was written, to the bit, or it is refused."""

import random

import pytest
import torch

from attnwarp.io import FileFormatError
from attnwarp.workdir import FORMAT, CheckpointClock, Workdir


def state():
    random = torch.Generator().manual_seed(0)
    return {
        "tensors": {"means": torch.randn(5, 3, generator=random), "empty": torch.zeros(0, 3)},
        "queue": [3, 1, 2],
        "settings": {"kind": "2d", "ssim": 0.2, "normal": None},
    }


def folder_of(path):
    return Workdir(path.parent, "a fit")


def refused(path, part="remove it to begin again"):
    with pytest.raises(FileFormatError) as caught:
        folder_of(path).load(path.name)
    assert str(path) in str(caught.value) and part in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_was_saved_is_loaded(tmp_path):
    folder = Workdir(tmp_path, "a fit")
    folder.save("c.pt", state())
    back = folder.load("c.pt")
    assert torch.equal(back["tensors"]["means"], state()["tensors"]["means"])
    assert (back["queue"], back["settings"]) == (state()["queue"], state()["settings"])


def test_every_flipped_bit_and_every_end_is_refused(tmp_path):
    path = tmp_path / "c.pt"
    folder_of(path).save(path.name, state())
    whole = path.read_bytes()
    draw = random.Random(0)
    positions = [*range(110), *draw.sample(range(110, len(whole)), 300)]
    for position in positions:
        damaged = bytearray(whole)
        damaged[position] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        refused(path)
    for end in range(0, len(whole), 61):
        path.write_bytes(whole[:end])
        refused(path)


def test_a_checkpoint_of_an_earlier_version_or_of_no_names_is_refused(tmp_path):
    path = tmp_path / "c.pt"
    torch.save(state(), path)
    refused(path, "not a checkpoint")
    folder_of(path).save(path.name, list(state().values()))
    refused(path, "not a checkpoint")
    folder_of(path).save(path.name, state())
    path.write_bytes(path.read_bytes().replace(b" %d " % FORMAT, b" %d " % (FORMAT - 1), 1))
    refused(path, "made by an older version")


@pytest.mark.parametrize("text", ['{"sha25": "0"}', "[]", "{"])
def test_a_record_that_says_nothing_of_its_picture_is_named(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"a\.json: .*remove it, it is made anew"):
        Workdir(tmp_path, "an edit").made("a.png")


def test_checkpoints_take_a_twentieth_of_the_time_however_long_one_takes(monkeypatch):
    """Oracle: a clock that only this test moves."""
    now = 0.0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    clock, writing = CheckpointClock(1.0), 0.0
    for _ in range(10_000):
        now += 0.1  # an iteration
        if clock.due:
            with clock.saving():
                now += 2.0
                writing += 2.0
    assert 0.03 < writing / now <= 0.055  # the first comes earlier
    quick = CheckpointClock(1.0)
    with quick.saving():
        pass
    now += 0.9
    assert not quick.due
    now += 0.2
    assert quick.due


def test_seconds_of_a_part_are_not_those_of_the_part_around_it(tmp_path, monkeypatch):
    now = 0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    seconds = Workdir(tmp_path, "an edit").seconds
    with seconds.part("edit"):
        now += 1
        with seconds.part("warp"):
            now += 10
        now += 100
    assert seconds.parts == {"edit": 101, "warp": 10}


@pytest.mark.door
@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("times.json", "{", "not JSON .*; remove it"),
        ("manifest.json", "{", "not JSON .*; name another folder"),
    ],
)
def test_a_file_of_another_content_is_named_with_the_remedy(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(FileFormatError, match=f"{name}: {message}"):
        Workdir(tmp_path, "an edit").claim({})
