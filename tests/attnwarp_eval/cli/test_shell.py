"""Signals and output that cannot be written. Oracles: exit codes of processes, lines on stderr."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

PRINTS = [sys.executable, "-m", "attnwarp_eval.cli.main", "cache", "info"]

INTERRUPTED = """
import os, signal
from attnwarp_eval.cli.shell import clear_errors, resumable

with clear_errors(), resumable(lambda: "3 cells are kept"):
    os.kill(os.getpid(), signal.{name})
    signal.pause()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_polite_kill_says_what_is_kept_as_ctrl_c_does(name):
    # A background job of a shell ignores SIGINT, and so would what it starts.
    program = "import typer\napp = typer.Typer()\n@app.command()\ndef main():\n"
    program += "".join(f"    {line}\n" for line in INTERRUPTED.format(name=name).splitlines())
    done = subprocess.run(
        [sys.executable, "-c", f"{program}\napp()"],
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert done.returncode == 130
    expected = "attnwarp-eval: interrupted; 3 cells are kept, the same command goes on from here\n"
    assert done.stderr == expected


def test_output_to_a_full_disk_is_one_line_and_exit_code_2():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(PRINTS, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "No space left on device" in done.stderr


@pytest.mark.parametrize("buffered", [True, False])
def test_a_closed_pipe_is_no_regression(buffered):
    reading, writing = os.pipe()
    os.close(reading)
    environment = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    done = subprocess.run(
        PRINTS, stdout=writing, stderr=subprocess.PIPE, env=environment, text=True, timeout=60
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")
