"""Oracles: exit codes of shells, lines counted, the file system."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from further import further

from attnwarp.cli.entry import expanded

BIN = Path(sys.executable).parent


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("--out=~/x/", "/home/me/x/"),
        ("~/x", "/home/me/x"),
        ("--out=~", "/home/me"),
        ("--out=a~b", "a~b"),
        ("--set=a=~/x", "/home/me/x"),
        ("make it ~ red", "make it ~ red"),
    ],
)
def test_a_home_folder_is_expanded_as_a_shell_would(argument, expected, monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert expanded(argument).rpartition("=")[2] == expected


def test_a_path_that_no_shell_expanded_is_in_the_home_folder(tmp_path):
    environment = {**os.environ, "HOME": str(tmp_path)}
    convert = [BIN / "attnwarp", "convert", "~/none.ply", "~/a.splat"]
    done = subprocess.run(
        convert, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False
    )
    assert str(tmp_path / "none.ply") in done.stderr
    assert not (tmp_path / "~").exists()


@pytest.mark.parametrize("name", further("SIGINT", "SIGTERM", "SIGHUP"))
def test_a_stop_while_a_command_is_imported_is_one_line(name, tmp_path):
    (tmp_path / "imported.py").write_text(
        f"import os, signal, time\nos.kill(os.getpid(), signal.{name})\ntime.sleep(9)"
    )
    # What started the tests may have it ignored, as nohup does.
    program = (
        f"import signal; signal.signal(signal.{name}, signal.default_int_handler)\n"
        "from attnwarp.cli.entry import enter; enter('attnwarp', 'imported')"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 130
    assert done.stderr == "attnwarp: stopped; nothing was written\n"


CUT_IMPORT = """
import os, signal, typer
from attnwarp.cli import shell

app = typer.Typer()

@app.command()
def command():
    with shell.clear_errors(strict={strict}):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()
        except KeyboardInterrupt as stop:
            raise ImportError("initialization failed") from stop

shell.run(app, "attnwarp")
"""


@pytest.mark.parametrize("strict", further(True, False))
def test_a_kill_that_an_import_turns_into_its_own_error_is_one_line(strict):
    """Errors of numpy and OpenCV are such."""
    done = subprocess.run(
        [sys.executable, "-c", CUT_IMPORT.format(strict=strict)], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (130, "attnwarp: stopped; nothing was written\n")


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.1, 0.3])
@pytest.mark.parametrize(
    "command",
    [
        ["attnwarp-eval", "inspect", "tiny", "--export", "a.glb"],
        ["attnwarp-eval", "cache", "info"],
        ["attnwarp-eval", "doctor"],
        ["attnwarp", "fit", "nowhere", "--out", "out"],
    ],
)
def test_an_early_interrupt_ends_in_at_most_one_line(command, seconds, tmp_path):
    process = subprocess.Popen(
        [BIN / command[0], *command[1:]], stderr=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True, cwd=tmp_path,
    )  # fmt: skip
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    if process.returncode == 130:
        assert said.count("\n") <= 1, said
    # It was done before, or its interpreter had not begun.
    assert process.returncode in (130, 0, 2, -signal.SIGINT)
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("command", "target"),
    further(
        (["attnwarp", "convert", "splats.ply", "{}/a.splat"], "nowhere/there"),
        (["attnwarp-eval", "run", "gate", "--out", "{}"], "itself"),
        (["attnwarp-eval", "scenes", "export", "tiny", "{}"], "itself"),
        (["attnwarp-eval", "stability", "--out", "{}"], "nowhere/there"),
        (["attnwarp-eval", "scenes", "render", "tiny", "--out", "{}"], "nowhere/there"),
    ),
)
def test_a_link_that_leads_nowhere_is_named_in_one_line(command, target, tmp_path):
    link = tmp_path / "out"
    link.symlink_to(link if target == "itself" else tmp_path / target)
    words = [BIN / command[0], *(word.format(link) for word in command[1:])]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, check=False)
    lines = [line for line in done.stderr.splitlines() if line.startswith(command[0])]
    assert done.returncode == 2, done.stderr
    assert len(lines) == 1 and "Traceback" not in done.stderr
    assert str(link) in lines[0] or "splats.ply" in lines[0]
