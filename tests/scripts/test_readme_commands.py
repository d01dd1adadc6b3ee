import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_every_command_of_the_readme_works_with_the_packages_of_the_demo(tmp_path):
    """In a clone, whose environment has the demo's extras alone."""
    clone = tmp_path / "clone"
    for words in (
        ["git", "clone", "--quiet", ROOT, clone],
        [clone / "scripts" / "venv.sh", "edit,eval"],
    ):
        subprocess.run(words, check=True, capture_output=True)
    call = [clone / ".venv/bin/python", clone / "scripts/readme_commands.py", clone / ".venv/bin"]
    done = subprocess.run(call, capture_output=True, text=True, cwd=clone)
    assert done.returncode == 0, done.stdout
