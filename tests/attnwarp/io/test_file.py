"""A file is written whole or not at all, and nothing is left lying about."""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from plyfile import PlyData

from attnwarp.errors import InputError
from attnwarp.io import file, write_points
from attnwarp.io.file import inside, write_atomically

KILLED = """
import os, signal, sys
from attnwarp.io.file import write_atomically
def half(stream):
    stream.write(b"half")
    stream.flush()
    os.kill(os.getpid(), signal.SIGKILL)
write_atomically(sys.argv[1], half)
"""


def test_what_a_killed_process_left_is_swept_up_by_the_next(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"old")
    done = subprocess.run([sys.executable, "-c", KILLED, tmp_path / "a.bin"], check=False)
    assert done.returncode == -signal.SIGKILL
    (left,) = tmp_path.glob(".*")
    assert left.read_bytes() == b"half" and (tmp_path / "a.bin").read_bytes() == b"old"
    # A living process's file, another machine's and a person's own stay.
    alive = left.name.replace(re.search(r"-(\d+)-", left.name)[1], str(os.getppid()))
    elsewhere = left.name.replace(file._host(), "0123abcd")
    for name in (alive, elsewhere, ".mine.tmp"):
        (tmp_path / name).write_bytes(b"")
    write_atomically(tmp_path / "b.bin", lambda stream: stream.write(b"new"))
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [alive, elsewhere, ".mine.tmp", "a.bin", "b.bin"]
    )


@pytest.mark.parametrize("durable", [True, False])
def test_a_write_that_raises_keeps_the_old_file(tmp_path, durable):
    write_atomically(tmp_path / "a", lambda stream: stream.write(b"old"))

    def fail(stream):
        stream.write(b"half")
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        write_atomically(tmp_path / "a", fail, durable=durable)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]


def test_files_of_other_machines_go_after_a_day_and_those_of_other_programs_never(tmp_path):
    token = "0" * 32
    names = [f".a.00000000-1-{token}.tmp", f".b.00000000-1-{token}.tmp", ".vim.tmp", "c.tmp"]
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    then = time.time() - file.ABANDONED_SECONDS - 60
    for name in names[1:]:
        os.utime(tmp_path / name, (then, then))
    assert file.remove_abandoned(tmp_path) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([names[0], *names[2:]])


def test_the_writers_of_a_persons_files_follow_a_link_and_the_others_replace_it(tmp_path):
    (tmp_path / "big").mkdir()
    (tmp_path / "big/old.ply").write_bytes(b"old")
    points = np.eye(3)
    for name in ("old.ply", "new.ply"):  # the second leads to a file that is not yet there
        (tmp_path / name).symlink_to(f"big/{name}")
        write_points(tmp_path / name, points)
        assert str((tmp_path / name).readlink()) == f"big/{name}"
        assert PlyData.read(tmp_path / "big" / name)["vertex"]["x"].tolist() == [1, 0, 0]
    write_atomically(tmp_path / "old.ply", lambda stream: stream.write(b"own"))
    assert not (tmp_path / "old.ply").is_symlink()
    assert (tmp_path / "big/old.ply").read_bytes() != b"own"
    assert {path.name for path in (tmp_path / "big").iterdir()} == {"new.ply", "old.ply"}


def test_a_folder_in_a_files_place_is_named_and_nothing_is_left(tmp_path):
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(IsADirectoryError, match=r"a\.ply: is a folder, expected a file"):
        write_atomically(tmp_path / "a.ply", lambda stream: stream.write(b"x"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_a_folder_that_takes_no_files_is_named_by_the_file_that_was_asked_for():
    """Linux's /proc, where root can write nothing either."""
    with pytest.raises(OSError, match="No such file") as caught:
        write_atomically("/proc/a.txt", lambda stream: stream.write(b"whole"))
    assert caught.value.filename == "/proc/a.txt"


@pytest.mark.parametrize("name", [255 * "n", 63 * "\N{GRINNING FACE}"], ids=["1 byte", "4 bytes"])
def test_a_name_as_long_as_the_file_system_takes_can_be_written(tmp_path, name):
    write_atomically(tmp_path / name, lambda stream: stream.write(b"whole"))
    assert (tmp_path / name).read_bytes() == b"whole"


def test_a_process_of_another_namespace_is_of_another_place(tmp_path, monkeypatch):
    """Containers may share the machine's name, but not the numbers of processes."""
    own = file._host()
    path = tmp_path / f".a.{own}-{2**22 + 1}-{'0' * 32}.tmp"
    path.write_bytes(b"")
    file._host.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(file.Path, "readlink", lambda path: file.Path("pid:[1]"))
        assert file._host() != own and file.remove_abandoned(tmp_path) == 0
    file._host.cache_clear()
    assert file._host() == own and file.remove_abandoned(tmp_path) == 1


@pytest.mark.parametrize(
    "name", ["../b", "a/../../b", "/etc/passwd", "link", "link/b", "loop", "a\0b"]
)
def test_a_name_that_leads_out_of_its_folder_is_refused(tmp_path, name):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    (folder / "loop").symlink_to(folder / "loop")
    with pytest.raises(InputError, match="leads out of"):
        inside(folder, name)
    for own in ("a", "a/../b", "...", "a/b..png", str(folder / "a")):
        assert inside(folder, own) == folder / own
