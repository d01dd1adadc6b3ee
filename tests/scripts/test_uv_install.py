"""uv installs from where pip would, as far as pip's settings name places (scripts/uv_install.py)."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from scripts import uv_install

SCRIPT = Path(uv_install.__file__)
PIP = [sys.executable, "-m", "pip"]


def _of_pip(config: str, tmp_path: Path, **variables: str) -> dict[str, str]:
    """Settings that the script reads where pip's one file is `config`."""
    (tmp_path / "pip.conf").write_text(config)
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PIP_")}
    kept |= {"PIP_CONFIG_FILE": str(tmp_path / "pip.conf"), "XDG_CONFIG_DIRS": str(tmp_path)}
    kept["HOME"] = str(tmp_path)  # nor its own file of a person or of the machine
    listing = subprocess.run(
        [*PIP, "config", "list"], env=kept | variables, capture_output=True, text=True, check=True
    )
    return uv_install.settings(listing.stdout)


def test_every_place_that_pips_files_name_is_an_option(tmp_path):
    of_pip = _of_pip(
        "[global]\nfind-links =\n    /wheels\n    /more\ntrusted-host = a.example\nno-index = true\n"
        "constraint = /c.txt\ncert = /ca.pem\ntimeout = 7\n",
        tmp_path,
    )
    assert uv_install.options(of_pip) == [
        "--find-links", "/wheels", "--find-links", "/more", "--constraints", "/c.txt",
        "--allow-insecure-host", "a.example", "--no-index",
    ]  # fmt: skip
    assert uv_install.environment(of_pip) == {"SSL_CERT_FILE": "/ca.pem", "UV_HTTP_TIMEOUT": "7"}


def test_the_environment_decides_over_install_and_that_over_global(tmp_path):
    config = "[global]\nindex-url = https://g.example\nproxy = http://g\n[install]\nproxy = http://i\n[freeze]\nproxy = http://f\n"
    of_pip = _of_pip(config, tmp_path, PIP_INDEX_URL="https://e.example")
    assert uv_install.options(of_pip)[:2] == ["--default-index", "https://e.example"]
    assert uv_install.environment(of_pip)["ALL_PROXY"] == "http://i"


@pytest.mark.skipif(importlib.util.find_spec("uv") is None, reason="uv is not installed")
def test_a_package_that_only_pips_settings_lead_to_is_installed(tmp_path):
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    with zipfile.ZipFile(wheels / "nowhere_else-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("nowhere_else.py", "answer = 42\n")
        info = "nowhere_else-1.0.dist-info"
        wheel.writestr(
            f"{info}/METADATA", "Metadata-Version: 2.1\nName: nowhere-else\nVersion: 1.0\n"
        )
        wheel.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        wheel.writestr(f"{info}/RECORD", "")
    (tmp_path / "pip.conf").write_text(f"[global]\nfind-links = {wheels}\nno-index = true\n")
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--no-cache", "--target", str(tmp_path / "to"), "nowhere-else"],
        env={**os.environ, "PIP_CONFIG_FILE": str(tmp_path / "pip.conf"), "PIP_FIND_LINKS": str(wheels)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "to" / "nowhere_else.py").read_text() == "answer = 42\n"
    assert "nowhere-else==1.0" in done.stderr
