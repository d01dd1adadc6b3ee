"""Install packages with uv as pip would: from the places that pip's settings name.

python scripts/uv_install.py ARGUMENTS of `uv pip install`

uv reads none of pip's settings. Those that say where packages are, and how they are reached, go
over as options and environment variables. This runs in the environment's own Python before anything
else is installed there, so the standard library has to do.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys

OPTIONS = {
    "index-url": "--default-index",
    "extra-index-url": "--index",
    "find-links": "--find-links",
    "constraint": "--constraints",
    "trusted-host": "--allow-insecure-host",
}
"""Options of uv by pip's setting, each given once for each of the setting's values."""

VARIABLES = {"cert": "SSL_CERT_FILE", "proxy": "ALL_PROXY", "default-timeout": "UV_HTTP_TIMEOUT"}
"""Environment variables of uv by pip's setting, or by `timeout`, its other name."""


def settings(listing: str) -> dict[str, str]:
    """The settings that `pip install` would use, from what `pip config list` prints.

    pip has merged its files by then. A variable of the environment decides over the section
    `install`, and that over `global`.

    >>> settings("global.cert='/a.pem'\\n:env:.cert='/b.pem'\\ninstall.find-links='/wheels /more'")
    {'cert': '/b.pem', 'find-links': '/wheels /more'}
    """
    found: dict[str, dict[str, str]] = {"global": {}, "install": {}, ":env:": {}}
    for line in listing.splitlines():
        name, separator, value = line.partition("=")
        section, _, key = name.rpartition(".")
        if separator and section in found:
            found[section][key] = ast.literal_eval(value)
    return {key: value for section in found.values() for key, value in section.items()}


def options(of_pip: dict[str, str]) -> list[str]:
    """Options of uv that say what pip's settings say.

    >>> options({"find-links": "/wheels /more", "no-index": "1"})
    ['--find-links', '/wheels', '--find-links', '/more', '--no-index']
    """
    given = [
        part
        for key, option in OPTIONS.items()
        for value in of_pip.get(key, "").split()
        for part in (option, value)
    ]
    if of_pip.get("no-index", "").lower() in {"1", "true", "yes", "on"}:
        given.append("--no-index")
    return given


def environment(of_pip: dict[str, str]) -> dict[str, str]:
    """Variables of uv that say what pip's settings say.

    >>> environment({"timeout": "60"})
    {'UV_HTTP_TIMEOUT': '60'}
    """
    renamed = {("default-timeout" if key == "timeout" else key): of_pip[key] for key in of_pip}
    return {variable: renamed[key] for key, variable in VARIABLES.items() if key in renamed}


def main(arguments: list[str]) -> int:
    """Run `uv pip install` for this Python, and give its exit code."""
    pip = [sys.executable, "-m", "pip", "config", "list"]
    listing = subprocess.run(pip, capture_output=True, text=True, check=True).stdout
    of_pip = settings(listing)
    # pip takes the best version of all indexes; uv would take the first index that has the name.
    uv = [sys.executable, "-m", "uv", "pip", "install", "--python", sys.executable]
    uv += ["--index-strategy", "unsafe-best-match", *options(of_pip), *arguments]
    return subprocess.run(uv, env={**os.environ, **environment(of_pip)}).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
