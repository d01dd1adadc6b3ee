"""Checks of a machine. Oracles: the machine as it is made here, and the exit codes of processes."""

import json
import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from attnwarp_eval.cli import machine
from attnwarp_eval.cli.doctor import lines
from attnwarp_eval.cli.machine import Check
from attnwarp_eval.cli.main import app
from attnwarp_eval.truth import llvm

COMMAND = [sys.executable, "-m", "attnwarp_eval"]


@pytest.mark.slow
def test_what_is_needed_works_here_and_each_lack_has_its_cost_and_remedy():
    done = subprocess.run([*COMMAND, "doctor", "--json"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout
    checks = {check["name"]: Check(**check) for check in json.loads(done.stdout)}
    # These tests themselves cast rays, render and read the weights.
    for name in ("versions", "exact geometry", "bundled weights"):
        assert checks[name].state == "ok", checks[name]
    for check in checks.values():
        assert bool(check.cost) == bool(check.remedy) == (check.state != "ok")


def test_a_missing_llvm_is_a_lack_unless_the_user_names_a_variant(tmp_path, monkeypatch):
    monkeypatch.delenv("ATTNWARP_MITSUBA", raising=False)
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "none.so"))
    try:
        for named, state in ((None, "lack"), ("scalar_rgb", "ok")):
            llvm.variant.cache_clear()
            if named:
                monkeypatch.setenv("ATTNWARP_MITSUBA", named)
            check = machine.pictures()
            assert (check.state, "scalar_rgb" in check.text) == (state, True)
            assert ("ATTNWARP_MITSUBA" in check.text) == bool(named)
    finally:
        llvm.variant.cache_clear()


def test_the_command_tells_the_version_that_the_doctor_has():
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0
    assert f"attnwarp {done.output.split()[1]}" in machine.versions().text


def test_lines_fit_a_terminal_of_80_columns():
    words = "a rather long text of many words about a machine " * 5
    text = lines(Check("3D window", "lack", words, words, words))
    assert max(map(len, text.splitlines())) < 80
    assert text.startswith("lack   3D window: a rather") and "\n         remedy: a rather" in text


def test_a_limit_of_the_cache_that_is_no_number_is_broken(tmp_path, monkeypatch):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path / "not" / "yet"))
    monkeypatch.setenv("ATTNWARP_CACHE_GB", "0.001")
    assert machine.cache().state == "ok"
    monkeypatch.setenv("ATTNWARP_CACHE_GB", "many")
    assert machine.cache().state == "broken"


def test_a_child_that_aborts_or_prints_nonsense_is_an_answer():
    assert machine._child("print('works')") == ("works", "")
    assert machine._child("import os; os.abort()") == ("", "ended with code -6")
    assert machine._child("import nothing_of_this_name")[1].startswith("ModuleNotFoundError")


def test_something_needed_that_is_broken_is_exit_code_2(monkeypatch):
    broken = Check("exact geometry", "broken", "Open3D casts no rays", "no truth", "install it")
    monkeypatch.setattr(machine, "checks", lambda: iter([broken]))
    for arguments in (["doctor"], ["doctor", "--json"]):
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 2
        assert done.stderr == "attnwarp-eval: broken: exact geometry\n"
    monkeypatch.setattr(machine, "checks", lambda: iter([Check("cores", "ok", "2")]))
    done = CliRunner().invoke(app, ["doctor"])
    assert (done.exit_code, done.stderr) == (0, "")


def test_a_shell_completes_commands():
    asked = {"COMP_WORDS": "attnwarp-eval do", "COMP_CWORD": "1"}
    environment = {**os.environ, **asked, "_ATTNWARP_EVAL_COMPLETE": "complete_bash"}
    program = (
        "import sys; sys.argv[0] = 'attnwarp-eval'; from attnwarp_eval.cli.main import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )
    assert done.stdout.split() == ["doctor"], done.stderr
