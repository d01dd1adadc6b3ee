"""Oracles: the arrays that were written, the file system, two real processes."""

import multiprocessing
import os
import re
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from attnwarp.errors import InputError
from attnwarp.io import file
from attnwarp_eval import cache
from attnwarp_eval.cli.main import app


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    return tmp_path


ARRAYS = {
    "floats": {"x": np.array([[0.1, -2.0], [3.5, 1e-300]])},
    "several kinds": {
        "ids": np.array([3, -1], np.int32),
        "valid": np.array([True, False]),
        "origin": np.float64(7.25),
    },
    "an empty and a small one": {"none": np.zeros((0, 3)), "rgb": np.array([1, 2, 3], np.uint8)},
}


@pytest.mark.parametrize("name", ARRAYS)
def test_no_flipped_bit_gives_another_number_and_a_damaged_file_is_named_once(name, folder, capsys):
    arrays = ARRAYS[name]
    cache.write_arrays("kind", "key", arrays)
    path = folder / "kind" / "key.npz"
    whole = path.read_bytes()
    with path.open("r+b", buffering=0) as file:
        for bit in range(8 * len(whole)):
            byte = bit // 8
            os.pwrite(file.fileno(), bytes([whole[byte] ^ 1 << bit % 8]), byte)
            assert cache.read_arrays("kind", "key") is None, f"bit {bit} of {len(whole)} bytes"
            os.pwrite(file.fileno(), whole[byte : byte + 1], byte)
    warning = f"attnwarp-eval: {path}: damaged; it is computed again\n"
    assert capsys.readouterr().err == warning
    # The run goes on: the same file is written anew and read.
    cache.write_arrays("kind", "key", arrays)
    assert path.read_bytes() == whole
    stored = cache.read_arrays("kind", "key")
    assert stored.keys() == arrays.keys()
    for key, value in arrays.items():
        assert stored[key].dtype == value.dtype and np.array_equal(stored[key], value)
    assert capsys.readouterr().err == ""


def test_a_file_cut_short_lengthened_or_under_another_name_is_not_read(folder, capsys):
    cache.write_arrays("kind", "key", {"x": np.arange(4.0)})
    path = folder / "kind" / "key.npz"
    whole = path.read_bytes()
    for size in range(0, len(whole), 7):
        path.write_bytes(whole[:size])
        assert cache.read_arrays("kind", "key") is None
    path.write_bytes(whole + b"\0")
    assert cache.read_arrays("kind", "key") is None
    (folder / "kind" / "other.npz").write_bytes(whole)
    assert cache.read_arrays("kind", "other") is None
    assert capsys.readouterr().err.count("damaged") == 2


def test_a_damaged_file_leaves_the_meshes_of_a_scene_as_they_are(folder, capsys):
    from attnwarp_eval.scene.file import load_scene

    def vertices():
        return [s.vertices for s in load_scene("bear").shapes() if hasattr(s, "vertices")]

    expected = vertices()
    path = min((folder / "meshes").glob("*.npz"), key=lambda p: p.stat().st_size)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 16
    path.write_bytes(data)
    assert all(map(np.array_equal, vertices(), expected))
    assert capsys.readouterr().err.count(f"{path}: damaged") == 1
    assert all(map(np.array_equal, vertices(), expected))
    assert capsys.readouterr().err == ""


def test_a_folder_that_cannot_be_written_to_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path / "file"))
    cache.write_arrays("kind", "key", {"x": np.zeros(3)})
    assert cache.read_arrays("kind", "key") is None


def test_temporary_files_of_a_dead_process_are_swept_up(folder):
    cache.write_arrays("kind", "key", {"x": np.zeros(3)})
    dead = f".other.npz.{file._host()}-{2**22 + 1}-{'0' * 32}.tmp"  # beyond every process's number
    (folder / "kind" / dead).write_bytes(b"half")
    cache.trim(10**9)
    assert [p.name for p in (folder / "kind").iterdir()] == ["key.npz"]


def _write(folder, value):
    os.environ["ATTNWARP_CACHE"] = folder
    for _ in range(60):
        cache.write_arrays("kind", "same", {"x": np.full(20_000, value)})


@pytest.mark.slow
def test_two_processes_that_write_the_same_entry_never_show_half_of_one(folder):
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write, args=(str(folder), value)) for value in (1.0, 2.0)]
    for writer in writers:
        writer.start()
    seen = 0
    while any(writer.is_alive() for writer in writers):
        time.sleep(0.001)  # the cores are the writers'
        if (folder / "kind" / "same.npz").exists():
            stored = cache.read_arrays("kind", "same")
            assert stored is not None and len(np.unique(stored["x"])) == 1
            seen += 1
    assert [writer.exitcode for writer in writers] == [0, 0] and seen > 0
    assert [p.name for p in (folder / "kind").iterdir()] == ["same.npz"]


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


@pytest.mark.parametrize("text", ["ten", "inf", "-inf", "nan", "-1", "1e300", "1e999"])
def test_a_limit_that_is_no_number_of_gigabytes_is_refused(folder, monkeypatch, text):
    monkeypatch.setenv("ATTNWARP_CACHE_GB", text)
    message = f"ATTNWARP_CACHE_GB: got '{text}', expected a number of gigabytes"
    with pytest.raises(InputError, match=message):
        cache.limit_bytes()
    with pytest.raises(InputError, match=message):
        cache.write_arrays("kind", "key", {"x": np.zeros(3)})
    refused = CliRunner().invoke(app, ["cache", "info"])
    assert refused.exit_code == 2 and "expected a number of gigabytes" in refused.output
    # A run says so before it begins: every one of its cells would fail.
    refused = CliRunner().invoke(app, ["run", "quick", "--out", str(folder / "run")])
    assert refused.exit_code == 2 and refused.stderr.count("\n") == 1
    assert refused.stderr.startswith(f"attnwarp-eval: ATTNWARP_CACHE_GB: got '{text}'")
    assert not (folder / "run").exists()


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
