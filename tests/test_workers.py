import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import all_reported
import pytest

MAKEFILE = (Path(__file__).parents[1] / "Makefile").read_text()
# A worker dies in the middle of one file, while the other has files of its own.
FILE = """
import os, pytest

@pytest.mark.parametrize("case", range(8))
def test_case(case):
    if {dies} and case == 3:
        os.abort()
"""


@pytest.mark.slow
def test_a_run_whose_worker_dies_ends_and_does_not_pass(tmp_path):
    """A dying worker that the other asks for tests may lose them, in place of failing one."""
    for number in range(4):
        (tmp_path / f"test_{number}.py").write_text(FILE.format(dies=number == 1))
    (distribution,) = re.findall(r"--dist \w+", MAKEFILE)
    options = ["-n", "2", *distribution.split(), "-p", "no:cacheprovider", "-p", "all_reported"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "."],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(all_reported.__file__).parent)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 1, run.stdout
    named = "crashed while running 'test_1.py::test_case[3]'" in run.stdout
    assert named or "tests were lost with their worker" in run.stdout


@pytest.mark.parametrize(("collected", "status"), [(["a", "b"], 0), (["a", "b", "c"], 1)])
def test_a_run_that_lost_a_test_does_not_pass(collected, status, monkeypatch):
    monkeypatch.setattr(all_reported, "reported", {"a", "b"})
    workers = SimpleNamespace(sched=SimpleNamespace(collection=collected))
    manager = SimpleNamespace(get_plugin=lambda name: workers)
    session = SimpleNamespace(config=SimpleNamespace(pluginmanager=manager), exitstatus=0)
    all_reported.pytest_sessionfinish(session, 0)
    assert session.exitstatus == status
