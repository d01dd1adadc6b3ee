import re
import subprocess
import sys
from pathlib import Path

MAKEFILE = (Path(__file__).parents[1] / "Makefile").read_text()
# A worker dies in the middle of one file, while the other has files of its own.
FILE = """
import os, pytest

@pytest.mark.parametrize("case", range(8))
def test_case(case):
    if {dies} and case == 3:
        os.abort()
"""


def test_a_worker_that_dies_fails_its_test_and_the_run_ends(tmp_path):
    for number in range(4):
        (tmp_path / f"test_{number}.py").write_text(FILE.format(dies=number == 1))
    (distribution,) = re.findall(r"--dist \w+", MAKEFILE)
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-n",
            "2",
            *distribution.split(),
            "-p",
            "no:cacheprovider",
            ".",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "1 failed, 31 passed" in run.stdout
    assert "crashed while running 'test_1.py::test_case[3]'" in run.stdout
