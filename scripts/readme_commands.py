"""Call every command of README and docs/start/quickstart.md in an environment, as of `make demo`.

    python scripts/readme_commands.py BIN [RUN]

BIN is the environment's folder of commands, RUN a finished run of the study `demo`. What ends soon
runs as it stands; of the rest the options are read (``--help``). Every command has to end with 0,
or with one line that names the extra it lacks. This needs the standard library alone.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

SOON = ("doctor", "encoders", "verify", "report", "scenes list", "scenes edits", "inspect")


def commands(text: str) -> list[list[str]]:
    """Words of each call of our commands in a document's shell blocks.

    Example:
        >>> commands("```sh\\nattnwarp-eval doctor   # what is here\\nmake test\\n```")
        [['attnwarp-eval', 'doctor']]
    """
    blocks = re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    split = [shlex.split(line, comments=True) for line in lines]
    return [words for words in split if words and words[0] in ("attnwarp", "attnwarp-eval")]


def problem(words: list[str], folder: Path, run: str | None) -> str | None:
    """Describe what goes wrong with a command; None for nothing."""
    here = [run if run and word in ("runs/mine", "runs/demo") else word for word in words[1:]]
    of_run = bool({"runs/mine", "runs/demo"} & {*words})
    soon = " ".join(here).startswith(SOON) and (run is not None or not of_run)
    soon = soon and words[:2] != ["attnwarp", "inspect"]  # of a capture that is not there
    if "inspect" in here:  # draws off screen
        here += ["--screenshot", "inspect.png"]
    done = subprocess.run(
        [folder / words[0], *(here if soon else [*here, "--help"])],
        capture_output=True,
        text=True,
        check=False,
    )
    one_line = done.returncode == 2 and done.stderr.count("\n") == 1
    if done.returncode == 0 or (one_line and "which comes with the extra" in done.stderr):
        return None
    return f"{' '.join(words)}: exit code {done.returncode}: {done.stderr[-2000:]}"


def main(folder: str, run: str | None = None) -> int:
    """Call them all; the number of those that fail."""
    root = Path(__file__).parents[1]
    pages = (root / name for name in ("README.md", "docs/start/quickstart.md"))
    found = [words for page in pages for words in commands(page.read_text(encoding="utf-8"))]
    problems = [text for words in found if (text := problem(words, Path(folder), run))]
    print("\n".join([*problems, f"{len(found) - len(problems)} of {len(found)} commands work"]))
    return len(problems)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
