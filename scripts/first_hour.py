"""Walk docs/start/quickstart.md in a fresh clone and report the seconds of each of its commands.

    python -m scripts.first_hour [--work FOLDER] [--out reports/first-hour/report.md]

Commands run in the order of the page, in a clone of this checkout's last commit, with the clone's
.venv/bin first on the path and an empty cache of derived files. A block of YAML that begins with
``# NAME.yaml`` is saved under that name. The walk ends at the first command that fails. This needs
the standard library alone.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = "docs/start/quickstart.md"
END = "\n## Every command\n"
BLOCK = re.compile(r"^```(sh|yaml)\n(.*?)^```|^## (.+?)$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Step:
    """A command of the page, or a file that it has the reader save.

    Attributes:
        section: heading above it.
        text: the command as a shell reads it, or the file's text.
        file: the file's name; None for a command.
    """

    section: str
    text: str
    file: str | None = None


@dataclass(frozen=True)
class Walked:
    """A command that ended well: wall seconds, and CPU seconds of it and its children."""

    step: Step
    wall: float
    cpu: float


def steps(page: str) -> list[Step]:
    """Commands and files of a page, in its order, up to its list of every command.

    Example:
        >>> [step.text for step in steps("## 1\\n```sh\\nmake demo   # minutes\\nls\\n```\\n")]
        ['make demo   # minutes', 'ls']
    """
    found: list[Step] = []
    section = ""
    for language, text, heading in BLOCK.findall(page.partition(END)[0]):
        if heading:
            section = heading
        elif language == "sh":
            lines = text.replace("\\\n", " ").splitlines()
            found += [Step(section, line) for line in lines if line.strip()]
        elif name := re.match(r"# (\S+\.yaml)\n", text):
            found.append(Step(section, text, name[1]))
    return found


def walk(folder: Path, todo: list[Step], log: Path) -> list[Walked]:
    """Carry out the steps in a folder; SystemExit with the end of the log where one fails."""
    environment = {**os.environ, "ATTNWARP_CACHE": str(log.parent / "cache")}
    environment["PATH"] = f"{folder / '.venv/bin'}{os.pathsep}{environment['PATH']}"
    environment.pop("DISPLAY", None)  # no window waits for a person
    walked = []
    commands = [step for step in todo if step.file is None]
    for step in todo:
        if step.file is not None:
            (folder / step.file).write_text(step.text, encoding="utf-8")
            continue
        print(f"[{commands.index(step) + 1}/{len(commands)}] {step.text}", flush=True)
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        with log.open("a", encoding="utf-8") as output:
            print(f"\n$ {step.text}", file=output, flush=True)
            done = subprocess.run(
                ["bash", "-c", step.text],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
            )
        wall, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        if done.returncode:
            tail = log.read_text(encoding="utf-8", errors="replace").splitlines()[-20:]
            sys.exit("\n".join([*tail, f"{step.text}: exit code {done.returncode}; {log} has all"]))
        print(f"    {wall:.0f} s", flush=True)
        walked.append(Walked(step, wall, cpu))
    return walked


def report(walked: list[Walked], commit: str) -> str:
    """Markdown: a row a command, and their sum."""
    wall, cpu = sum(each.wall for each in walked), sum(each.cpu for each in walked)
    machine = f"{os.cpu_count()} hardware threads, {platform.machine()}"
    rows = [
        f"| {each.step.section} | `{each.step.text}` | {each.wall:.0f} | {each.cpu:.0f} |\n"
        for each in walked
    ]
    return f"""# How long does the first hour take?

All commands of [the first hour](../../{PAGE}), one after the other in a fresh clone of {commit},
took {wall / 60:.0f} minutes. The cache of derived files was empty. pip's may have had packages.

{machine}, Python {platform.python_version()}.

| part | command | seconds | CPU seconds |
|---|---|---|---|
{"".join(rows)}| all | | {wall:.0f} | {cpu:.0f} |
"""


def main() -> None:
    """Clone, walk, write the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--page", type=Path, default=ROOT / PAGE, help="another page of commands")
    parser.add_argument("--work", type=Path, default=ROOT / "build/first-hour", help="new folder")
    parser.add_argument("--out", type=Path, default=ROOT / "reports/first-hour/report.md")
    given = parser.parse_args()
    work = given.work.resolve()
    if work.exists():
        sys.exit(f"{work}: is there; remove it, or name a new folder by --work")
    clone = work / "clone"
    subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
    head = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(head, cwd=clone, check=True, capture_output=True, text=True).stdout
    walked = walk(clone, steps(given.page.read_text(encoding="utf-8")), work / "log.txt")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(report(walked, commit.strip()), encoding="utf-8")
    print(given.out)


if __name__ == "__main__":
    main()
