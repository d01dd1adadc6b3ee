"""Oracles: hashlib on bytes written by hand, the file system itself."""

import hashlib
import json
import multiprocessing
import os
import signal
import time

import pytest

from attnwarp_eval.files import canonical_json, write_atomic
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.store import Store, StoreError

SPEC = {"probe": "depth", "scene": "abc", "seed": 0}


def record(**extra):
    return {"id": Cell(SPEC, "s", "v", "depth", 0).id, "spec": SPEC, "summary": {"x": 1.5}, **extra}


def test_a_cells_id_is_the_sha256_of_its_canonical_json():
    text = b'{"probe":"depth","scene":"abc","seed":0}'
    assert Cell(SPEC, "s", "v", "depth", 0).id == hashlib.sha256(text).hexdigest()


def test_the_id_depends_on_content_and_not_on_names_or_key_order():
    shuffled = dict(reversed(list(SPEC.items())))
    assert Cell(SPEC, "a", "b", "depth", 0).id == Cell(shuffled, "x", "y", "depth", 0).id
    assert Cell({**SPEC, "seed": 1}, "a", "b", "depth", 1).id != Cell(SPEC, "a", "b", "depth", 0).id


def test_the_order_of_views_is_part_of_the_id():
    first = Cell({**SPEC, "views": ["a", "b"]}, "s", "v", "depth", 0)
    second = Cell({**SPEC, "views": ["b", "a"]}, "s", "v", "depth", 0)
    assert first.id != second.id


def test_nan_cannot_hide_in_canonical_json():
    with pytest.raises(ValueError, match="JSON"):
        canonical_json({"x": float("nan")})


def test_a_record_reads_back_as_written(tmp_path):
    store = Store(tmp_path)
    store.write(record())
    assert store.read(record()["id"])["summary"] == {"x": 1.5}
    assert store.done() == {record()["id"]}


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: r["summary"].update(x=1.6), "checksum"),
        (lambda r: r["spec"].update(seed=2), "hash of its spec"),
        (lambda r: r.update(format=0), "format"),
    ],
)
def test_a_changed_record_is_refused_with_the_remedy(tmp_path, damage, message):
    store = Store(tmp_path)
    store.write(record())
    path = store.path(record()["id"])
    data = json.loads(path.read_text())
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(StoreError, match=message) as caught:
        store.read(record()["id"])
    assert str(path) in str(caught.value)
    assert "run again" in str(caught.value)


def test_a_truncated_record_is_refused(tmp_path):
    store = Store(tmp_path)
    store.write(record())
    path = store.path(record()["id"])
    path.write_bytes(path.read_bytes()[:20])
    with pytest.raises(StoreError, match="not JSON"):
        store.read(record()["id"])


def test_verify_names_missing_failed_damaged_and_unexpected_cells(tmp_path):
    store = Store(tmp_path)
    picture = tmp_path / "pictures" / "a.png"
    write_atomic(picture, b"png")
    good = record(
        pictures=[{"path": "pictures/a.png", "sha256": hashlib.sha256(b"png").hexdigest()}]
    )
    store.write(good)
    other = Cell({**SPEC, "seed": 9}, "s", "v", "depth", 9)
    store.write({"id": other.id, "spec": other.spec})
    store.write_failure("f" * 64, {"error": "ValueError: no"})
    cells = [
        {"id": good["id"], "title": "good"},
        {"id": "f" * 64, "title": "fails"},
        {"id": "e" * 64, "title": "absent"},
    ]
    store.write_study({"cells": cells})
    problems = store.verify()
    assert problems.missing == ["absent"]
    assert problems.failed == ["fails: ValueError: no"]
    assert problems.unexpected == [other.id]
    assert problems.damaged == []
    assert not problems.ok
    picture.write_bytes(b"other")
    assert "changed since" in store.verify().damaged[0]
    picture.unlink()
    assert "missing" in store.verify().damaged[0]


def test_a_folder_that_is_not_a_run_says_how_to_make_one(tmp_path):
    with pytest.raises(StoreError, match="attnwarp-eval run"):
        Store(tmp_path).verify()


def test_a_second_run_on_the_same_folder_is_refused(tmp_path):
    with (
        Store(tmp_path).lock(),
        pytest.raises(StoreError, match="another run"),
        Store(tmp_path).lock(),
    ):
        pass


def test_success_forgets_the_former_failure(tmp_path):
    store = Store(tmp_path)
    store.write_failure(record()["id"], {"error": "x"})
    assert len(store.failures()) == 1
    store.write(record())
    assert store.failures() == []


def _write_forever(path):
    for i in range(10**9):
        write_atomic(path, str(i % 10).encode() * 200_000)


def test_a_file_is_whole_however_its_writer_was_killed(tmp_path):
    path = tmp_path / "cell.json"
    context = multiprocessing.get_context("spawn")
    for delay in (0.05, 0.1, 0.15):
        process = context.Process(target=_write_forever, args=(path,))
        process.start()
        deadline = time.monotonic() + 30
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(delay)
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        data = path.read_bytes()
        assert len(data) == 200_000
        assert len(set(data)) == 1
