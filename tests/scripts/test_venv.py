"""Messages of scripts/venv.sh, without an installation."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "venv.sh"


@pytest.mark.parametrize(("option", "code"), [("--help", 0), ("-h", 0), ("--hlep", 2)])
def test_an_option_is_answered_and_nothing_is_installed(tmp_path, option, code):
    (tmp_path / "scripts").mkdir()
    shutil.copy(SCRIPT, tmp_path / "scripts")
    done = subprocess.run(
        ["bash", str(tmp_path / "scripts" / "venv.sh"), option], capture_output=True, text=True
    )
    assert done.returncode == code
    assert "scripts/venv.sh [EXTRAS]" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["scripts"]
