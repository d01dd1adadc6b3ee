"""Oracles: the file system, NumPy's own reader, two real processes."""

import multiprocessing
import os
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp_eval import cache
from attnwarp_eval.cli.main import app


def test_arrays_read_back_bit_for_bit_and_a_damaged_file_is_no_file(tmp_path, monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    x = np.random.default_rng(0).normal(size=(7, 3))
    cache.write_arrays("kind", "key", {"x": x})
    assert np.array_equal(np.load(tmp_path / "kind" / "key.npz")["x"], x)
    assert np.array_equal(cache.read_arrays("kind", "key")["x"], x)
    assert cache.read_arrays("kind", "other") is None
    (tmp_path / "kind" / "key.npz").write_bytes(b"PK half a file")
    assert cache.read_arrays("kind", "key") is None


def _write(folder, value):
    os.environ["ATTNWARP_CACHE"] = folder
    for _ in range(30):
        cache.write_arrays("kind", "key", {"x": np.full(20_000, value)})


def test_two_processes_that_write_at_once_leave_one_whole_file(tmp_path, monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write, args=(str(tmp_path), value)) for value in (1.0, 2.0)]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        found = cache.read_arrays("kind", "key")
        assert found is None or len(set(found["x"])) == 1
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert [p.name for p in (tmp_path / "kind").iterdir()] == ["key.npz"]


def test_the_oldest_files_go_when_the_folder_is_over_its_limit(tmp_path, monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    for age, key in enumerate(("new", "middle", "old")):
        cache.write_arrays("kind", key, {"x": np.zeros(1000)})
        then = 1_000_000_000 - age
        os.utime(tmp_path / "kind" / f"{key}.npz", (then, then))
    size = (tmp_path / "kind" / "new.npz").stat().st_size
    assert cache.usage() == {"kind": (3, 3 * size)}
    assert cache.trim(2 * size) == size
    assert {p.stem for p in (tmp_path / "kind").glob("*.npz")} == {"new", "middle"}
    # A limit below one file still keeps nothing half-written: the write itself succeeds, then
    # everything goes.
    monkeypatch.setenv("ATTNWARP_CACHE_GB", "0")
    cache.write_arrays("kind", "last", {"x": np.zeros(10)})
    assert cache.usage() == {}


def test_a_limit_that_is_no_number_is_refused(monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE_GB", "ten")
    with pytest.raises(InputError, match="got 'ten', expected a number of gigabytes"):
        cache.limit_bytes()


def test_many_small_writes_do_not_each_look_at_every_file_and_stay_within_a_hundredth_of_the_limit(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    monkeypatch.setenv("ATTNWARP_CACHE_GB", "0.001")
    looks = 0
    trim = cache.trim

    def counted(limit):
        nonlocal looks
        looks += 1
        return trim(limit)

    monkeypatch.setattr(cache, "trim", counted)
    sizes = []
    for k in range(600):
        cache.write_arrays("kind", f"{k:04}", {"x": np.full(400, float(k))})
        sizes.append(sum(path.stat().st_size for path in (tmp_path / "kind").iterdir()))
    assert all((tmp_path / "kind" / f"{k:04}.npz").exists() for k in range(590, 600))
    assert max(sizes) > 0.9e6 and max(sizes) <= 1.01e6 + 4000
    assert looks < 250


def test_the_command_line_tells_what_lies_in_the_cache_and_removes_it(tmp_path, monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    monkeypatch.delenv("ATTNWARP_CACHE_GB", raising=False)
    runner = CliRunner()
    empty = runner.invoke(app, ["cache", "info"])
    assert empty.exit_code == 0 and re.search(r"all +0 files +0\.0 MB", empty.stdout)
    for kind, number in (("meshes", 1), ("pictures", 2)):
        for k in range(number):
            path = tmp_path / kind / f"{k}.npz"
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(bytes(1_500_000))
    told = runner.invoke(app, ["cache", "info"])
    assert told.exit_code == 0 and str(tmp_path) in told.stdout.replace("\n", "")
    assert re.search(r"meshes +1 files +1\.5 MB", told.stdout) and re.search(
        r"pictures +2 files +3\.0 MB", told.stdout
    )
    assert re.search(r"all +3 files +4\.5 MB", told.stdout)
    cleared = runner.invoke(app, ["cache", "clear"])
    assert cleared.exit_code == 0 and "4.5 MB removed" in cleared.stdout
    assert not list(tmp_path.rglob("*.npz")) and tmp_path.is_dir()
    monkeypatch.setenv("ATTNWARP_CACHE_GB", "much")
    wrong = runner.invoke(app, ["cache", "info"])
    assert wrong.exit_code == 2 and "ATTNWARP_CACHE_GB" in wrong.output
