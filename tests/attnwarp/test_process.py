"""The oracles are the interpreter's own count of what its collector leaves alone, and its exit by
KeyboardInterrupt.
"""

import os
import platform
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import attnwarp.cli.main
from attnwarp.process import STOPS, asked_to_stop, core_count, stops_interrupt


def test_nothing_is_left_to_search_as_the_process_ends():
    code = (
        "import atexit, gc, sys; from attnwarp.process import skip_last_collection;"
        # Registered first, it runs last.
        "atexit.register(lambda: print(gc.get_freeze_count() > 0, len(gc.get_objects()) < 50));"
        "skip_last_collection(); print(gc.get_freeze_count(), 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "False", "True", "True"]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc's allocator")
def test_memory_freed_by_one_step_serves_the_next():
    """The system counts the pages that it cleared: 3,064 a step of 63 MB without."""
    code = (
        "import resource, numpy; from attnwarp.process import keep_freed_memory;"
        "step = lambda: [numpy.ones(10 << 17) for _ in range(6)] and None;"
        "faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt;"
        "keep_freed_memory(); [step() for _ in range(4)];"
        "before = faults(); [step() for _ in range(4)]; print(faults() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 100


@pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"),
    reason="this system has no os.sched_setaffinity, with which the test takes cores away",
)
def test_cores_are_those_that_this_process_may_use(monkeypatch):
    cores = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(cores)})
        assert core_count() == 1
    finally:
        os.sched_setaffinity(0, cores)
    assert core_count() == len(cores)
    # As on macOS.
    monkeypatch.delattr(os, "sched_getaffinity")
    assert core_count() == os.cpu_count()


def test_the_command_tells_its_version():
    """Oracle: the project's own file."""
    root = Path(__file__).parents[2]
    version = tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"]
    done = CliRunner().invoke(attnwarp.cli.main.app, ["--version"])
    assert (done.exit_code, done.output) == (0, f"attnwarp {version}\n")


def test_a_signal_that_a_shell_has_a_background_job_ignore_stays_ignored():
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with asked_to_stop() as asked:
            signal.raise_signal(signal.SIGINT)
            assert not asked()
            signal.raise_signal(signal.SIGTERM)
            assert asked()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, handler)


@pytest.mark.parametrize("number", STOPS)
def test_what_asks_a_program_to_end_interrupts_it_unless_it_is_ignored(number):
    former = signal.signal(number, signal.SIG_DFL)  # under nohup it is ignored
    try:
        with pytest.raises(KeyboardInterrupt), stops_interrupt():
            signal.raise_signal(number)
        assert signal.getsignal(number) is signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN)  # as nohup does
        with stops_interrupt():
            signal.raise_signal(number)
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, former)


@pytest.mark.parametrize(
    ("package", "command"), [("attnwarp", "attnwarp"), ("attnwarp_eval", "attnwarp-eval")]
)
def test_a_package_is_its_command(package, command):
    """Oracle: the console script that the installation made."""
    both = [
        subprocess.run(call, capture_output=True, text=True)
        for call in (
            [sys.executable, "-m", package, "--version"],
            [Path(sys.executable).parent / command, "--version"],
        )
    ]
    assert [done.returncode for done in both] == [0, 0]
    assert both[0].stdout == both[1].stdout
