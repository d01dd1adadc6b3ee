"""A file is written whole or not at all, and nothing is left lying about."""

import os
import re
import signal
import subprocess
import sys

import pytest

from attnwarp.io import file
from attnwarp.io.file import write_atomically

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


def test_a_write_that_raises_keeps_the_old_file(tmp_path):
    write_atomically(tmp_path / "a", lambda stream: stream.write(b"old"))

    def fail(stream):
        stream.write(b"half")
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        write_atomically(tmp_path / "a", fail)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
