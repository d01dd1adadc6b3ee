"""Signals and output that cannot be written. Oracles: exit codes of processes, lines on stderr."""

import errno
import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import typer
from further import further
from typer.core import TyperOption
from typer.testing import CliRunner

import attnwarp.cli.main
from attnwarp.cli.shell import file_error
from attnwarp_eval.cli import main

PRINTS = [sys.executable, "-m", "attnwarp_eval", "cache", "info"]

INTERRUPTED = """
import os, signal
from attnwarp_eval.cli.shell import clear_errors, resumable

with clear_errors(), resumable(lambda: "3 cells are kept"):
    os.kill(os.getpid(), signal.{name})
    signal.pause()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_polite_kill_says_what_is_kept_as_ctrl_c_does(name):
    program = "import typer\nfrom attnwarp.cli.options import program_options\napp = typer.Typer(name='attnwarp-eval')\napp.callback()(program_options)\n@app.command()\ndef main():\n"
    program += "".join(f"    {line}\n" for line in INTERRUPTED.format(name=name).splitlines())
    done = subprocess.run(
        [sys.executable, "-c", f"{program}\napp(['main'], prog_name='attnwarp-eval')"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 130
    expected = "attnwarp-eval: stopped; 3 cells are kept, the same command goes on from here\n"
    assert done.stderr == expected


@pytest.mark.parametrize(
    ("moment", "line"),
    [
        ("attnwarp.process", "attnwarp-eval: stopped; nothing was written\n"),
        ("attnwarp_eval.study.study", "attnwarp-eval: stopped\n"),
    ],
)
def test_ctrl_c_during_an_import_ends_in_one_line(moment, line):
    """The signal comes as the module's import begins: of the command, and of what a command needs."""
    program = f"""
import signal, sys

class Interrupt:
    def find_spec(self, name, *rest):
        if name == {moment!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
sys.argv = ["attnwarp-eval", "run", "quick", "--dry-run"]
from attnwarp_eval.__main__ import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=200
    )
    assert (done.returncode, done.stderr) == (130, line)


def test_without_a_command_a_newcomer_reads_what_to_do_first():
    done = subprocess.run([*PRINTS[:3]], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.count("\n") <= 10
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith("  ")]
    assert [line[1] for line in lines] == ["run", "inspect", "metrics", "compare"]


def commands(group, *words):
    """A group and the commands below it, each with the words that call it."""
    yield [*words], group
    for name, command in getattr(group, "commands", {}).items():
        yield from commands(command, *words, name)


@pytest.mark.parametrize("app", [main.app, attnwarp.cli.main.app])
def test_each_options_help_is_a_sentence_and_no_flag_seems_to_take_a_value(app):
    for words, command in commands(typer.main.get_command(app)):
        options = [option for option in command.params if isinstance(option, TyperOption)]
        for option in options if words else ():
            text = option.help or ""
            told = f"{' '.join(words)} --{option.name}: {text}"
            assert text[:1].isupper() and text.endswith(".") and len(text.split()) > 3, told
        help_of = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "120"})
        assert "--help" in help_of.stdout and "<bool>" not in help_of.stdout, words


def test_output_to_a_full_disk_is_one_line_and_exit_code_2():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(PRINTS, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "No space left on device" in done.stderr


@pytest.mark.parametrize("buffered", further(False, True))  # a pipe is buffered below, too
def test_a_closed_pipe_is_no_regression(buffered):
    reading, writing = os.pipe()
    os.close(reading)
    environment = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    done = subprocess.run(
        PRINTS, stdout=writing, stderr=subprocess.PIPE, env=environment, text=True, timeout=60
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


def test_an_error_of_a_connection_does_not_blame_the_disk():
    assert file_error(TimeoutError()) == (
        "a connection between processes failed (TimeoutError); run the same command again"
    )
    missing = FileNotFoundError("runs/a.png: the folder runs does not exist; make it first")
    assert file_error(missing) == str(missing)
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "run/study.json")
    assert file_error(full).startswith("run/study.json: No space left on device; check the path")


@pytest.mark.door
def test_commands_of_a_package_that_is_broken_leave_the_others(monkeypatch, capsys):
    broken = EntryPoint("mine", "no_such_package:COMMANDS", main.GROUP)
    monkeypatch.setattr(main, "entry_points", lambda group: [broken])
    assert main.plugin_commands() == {}
    assert "'no_such_package:COMMANDS' cannot be imported" in capsys.readouterr().err
