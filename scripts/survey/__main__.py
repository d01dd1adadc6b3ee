"""Read meshes, transforms.json and COLMAP models, each by two readers, and report differences.

python -m scripts.survey --packages downloads --rounds 3 --out report.md

The exit code is 1 if a file was read differently without a word, or failed without a message.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2

from scripts.survey import meshes, models, packages, transforms
from scripts.survey.outcome import FAILURES, Outcome, Row

PROGRAMS = ("trimesh", "pyvista", "vtk", "pycolmap")

CELL = 90
"""Longest message in a table."""


def survey(folder: Path, options: argparse.Namespace, seed: int) -> Iterator[Row]:
    """The rows of one round; what does not depend on the seed comes in the first alone."""
    if "meshes" in options.parts:
        cases = [*meshes.made(folder, seed)]
        if seed == options.seed:
            cases += [*meshes.by_libraries(folder), *meshes.shipped()]
            cases += meshes.in_folders(options.meshes)
            if options.packages:
                cases += published(options.packages)
        yield from (meshes.compare(case) for case in cases[: options.limit])
    if "transforms" in options.parts:
        for name in [*transforms.VARIANTS][: options.limit]:
            yield transforms.compare(name, transforms.write(folder, name, seed))
    if "colmap" in options.parts:
        if importlib.util.find_spec("pycolmap") is None:
            print("pycolmap is not installed: no camera models are compared", file=sys.stderr)
        else:
            yield from models.rows(folder / "colmap", models.model_names()[: options.limit], seed)


def published(folder: Path) -> Iterator[meshes.Case]:
    """The meshes of every package that can be had; the others are named on standard error."""
    for package in packages.PACKAGES:
        try:
            yield from packages.meshes_of(package, folder)
        except OSError as error:
            print(f"{package}: its meshes are left out: {error}", file=sys.stderr)


def report(rounds: Sequence[Sequence[Row]]) -> str:
    """The report: counts, failures, and every file of the first round that is not the same."""
    rows = [row for each in rounds for row in each]
    failures = [row for row in rows if row.outcome in FAILURES]
    parts = list(dict.fromkeys(row.part for row in rows))
    counts = Counter((row.part, row.outcome) for row in rows)
    lines = [
        "# Survey of files",
        "",
        f"{len(rows)} files in {len(rounds)} rounds, each read by this package and by a second"
        " reader. Rounds differ in the seed of",
        "shapes, poses and coefficients. Second readers: trimesh and closed forms for meshes (of"
        " planar polygons, Newell's formula); a",
        "reader of its own with OpenCV's lenses for transforms.json; pycolmap's projection for"
        " COLMAP.",
        "",
        f"**{len(failures)} silent differences or errors without a message.**",
        "",
        "| files | " + " | ".join(Outcome) + " | all |",
        "|---" * (len(Outcome) + 2) + "|",
    ]
    for part in parts:
        numbers = [counts[part, outcome] for outcome in Outcome]
        lines.append(f"| {part} | {' | '.join(map(str, numbers))} | {sum(numbers)} |")
    versions = ", ".join(f"{name} {version}" for name, version in _versions())
    lines += ["", f"Versions: {versions}."]
    lines += _origins([row for row in rounds[0] if row.part == meshes.PART])
    if failures:
        lines += ["", "## Failures", "", *_table(failures)]
    first = [row for row in rounds[0] if row.outcome not in (Outcome.SAME, *FAILURES)]
    for part in parts:
        listed = [row for row in first if row.part == part]
        if listed:
            lines += ["", f"## Not the same: {part}, first round", "", *_table(listed)]
    noted = Counter(
        "trimesh has other values than the closed form" if " has " in row.detail else row.detail
        for row in rounds[0]
        if row.outcome is Outcome.SAME and row.detail
    )
    if noted:
        lines += ["", "## The same, with a remark, first round", "", "| remark | files |"]
        lines += ["|---|---|"]
        lines += [f"| {_cell(remark)} | {count} |" for remark, count in noted.most_common()]
    return "\n".join(lines) + "\n"


def _origins(rows: Sequence[Row]) -> list[str]:
    """The meshes of the first round by who made them."""
    if not rows:
        return []
    counts = Counter((row.name.partition(": ")[0], row.outcome) for row in rows)
    outcomes = [outcome for outcome in Outcome if any(key[1] is outcome for key in counts)]
    lines = ["", "## Meshes by origin, first round", ""]
    lines += [f"| origin | {' | '.join(outcomes)} | all |", "|---" * (len(outcomes) + 2) + "|"]
    for origin in dict.fromkeys(key[0] for key in counts):
        numbers = [counts[origin, outcome] for outcome in outcomes]
        lines.append(f"| {origin} | {' | '.join(map(str, numbers))} | {sum(numbers)} |")
    theirs = sum(row.name.partition(": ")[0] not in meshes.WRITTEN_HERE for row in rows)
    made = "`made`, `trimesh` and `VTK` are written by the survey"
    lines += ["", f"{theirs} files are other people's; {made} with closed forms."]
    return lines


def _table(rows: Sequence[Row]) -> list[str]:
    """Rows of one outcome and message in one line."""
    groups: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        message = row.detail.partition(": ")[2] if row.name.endswith(
            row.detail.partition(": ")[0]) else row.detail  # fmt: skip
        groups.setdefault((row.outcome, message), []).append(row.name)
    return [
        "| file | outcome | what was said |",
        "|---|---|---|",
        *(
            f"| {_cell(', '.join(names))} | {outcome} | {_cell(message)} |"
            for (outcome, message), names in groups.items()
        ),
    ]


def _cell(text: str) -> str:
    text = " ".join(text.split()).replace("|", "\\|")
    return text if len(text) <= CELL else f"{text[:CELL]}..."


def _versions() -> Iterator[tuple[str, str]]:
    for name in PROGRAMS:
        try:
            yield name, importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    yield "OpenCV", cv2.__version__


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the survey; the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m scripts.survey", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--out", type=Path, help="write the report here instead of printing it")
    parser.add_argument("--meshes", type=Path, nargs="+", default=[], metavar="DIR",
                        help="folders with meshes of your own")  # fmt: skip
    parser.add_argument("--packages", type=Path, metavar="DIR",
                        help="also meshes of published packages, downloaded to DIR")  # fmt: skip
    parser.add_argument("--rounds", type=int, default=1, help="repeat with other seeds (1)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first round (0)")
    parser.add_argument("--limit", type=int, help="only so many of each part")
    parser.add_argument("--parts", nargs="+", default=["meshes", "transforms", "colmap"],
                        choices=["meshes", "transforms", "colmap"],
                        help="what to survey (all)")  # fmt: skip
    options = parser.parse_args(arguments)
    for folder in options.meshes:
        if not folder.is_dir():
            parser.error(f"--meshes {folder}: no such folder; name one that holds meshes")
    if options.rounds < 1 or (options.limit is not None and options.limit < 1):
        parser.error("--rounds and --limit: expected at least 1")
    if options.out and not options.out.parent.is_dir():
        parser.error(f"--out {options.out}: its folder does not exist; make it first")
    rounds: list[list[Row]] = []
    for k in range(options.rounds):
        rounds.append([])
        with tempfile.TemporaryDirectory() as folder:
            for row in survey(Path(folder), options, options.seed + k):
                rounds[-1].append(row)
                if row.outcome in FAILURES:
                    print(f"{row.part}: {row.name}: {row.outcome}: {row.detail}", file=sys.stderr)
                if len(rounds[-1]) % 50 == 0:
                    count = f"{len(rounds[-1])} files"
                    print(f"round {k + 1} of {options.rounds}: {count}", file=sys.stderr)
    text = report(rounds)
    if options.out:
        options.out.write_text(text)
    else:
        sys.stdout.write(text)
    return int(any(row.outcome in FAILURES for each in rounds for row in each))


if __name__ == "__main__":
    sys.exit(main())
