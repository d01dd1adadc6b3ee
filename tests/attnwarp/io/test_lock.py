"""Locks of folders, held against another process."""

from __future__ import annotations

import subprocess
import sys

import pytest

from attnwarp.errors import InputError
from attnwarp.io.lock import alone_in

HOLDS = """
import sys
from attnwarp.io.lock import alone_in
with alone_in(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    command = [sys.executable, "-c", HOLDS, str(tmp_path / "out")]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_folder_of_another_process_is_refused_until_that_ends(tmp_path, holder):
    folder = tmp_path / "out"
    with pytest.raises(InputError, match="out: another run writes to this folder"):
        alone_in(folder).__enter__()
    holder.kill()  # no chance to let go
    holder.wait()
    with alone_in(folder):
        assert list(folder.iterdir()) == []


def test_a_folder_that_was_made_and_not_used_is_removed(tmp_path):
    with alone_in(tmp_path / "unused"):
        pass
    assert not (tmp_path / "unused").exists()
    (tmp_path / "kept").mkdir()
    with alone_in(tmp_path / "kept"):
        pass
    with alone_in(tmp_path / "used"):
        (tmp_path / "used" / "result").touch()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept", "used"]


@pytest.mark.door
def test_an_error_lets_go(tmp_path):
    for _ in range(2):
        with pytest.raises(KeyError), alone_in(tmp_path):
            raise KeyError
    with alone_in(tmp_path):
        assert list(tmp_path.iterdir()) == []


def test_a_file_in_its_place(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(FileExistsError):
        alone_in(tmp_path / "out").__enter__()
