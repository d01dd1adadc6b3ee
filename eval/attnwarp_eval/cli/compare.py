"""The command that compares a run with a baseline."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import fail, log, warn
from attnwarp_eval.cli.shell import (
    TOO_LITTLE,
    Regression,
    check_not_of_run,
    clear_errors,
)

if TYPE_CHECKING:
    from attnwarp_eval.compare import Snapshot
    from attnwarp_eval.compare.judge import Comparison
    from attnwarp_eval.compare.pictures import Pictures
    from attnwarp_eval.study.results import Results


MOST_NAMED = 5
"""Scenes and cells that a line names."""


def compare(
    baseline: Annotated[
        Path,
        typer.Argument(
            help="A baseline's file (.jsonl), raw results (.jsonl.xz), a report's folder of"
            " them, or another run's folder."
        ),
    ],
    run: Annotated[Path, typer.Argument(help="The run's folder.")],
    markdown: Annotated[
        Path | None, option("Write the comparison to this file as Markdown, for a CI.", "FILE")
    ] = None,
    json: Annotated[
        Path | None, option("Write every verdict to this file as JSON, for a program.", "FILE")
    ] = None,
    html: Annotated[
        Path | None, option("Write a page to this file, with pictures before and after.", "FILE")
    ] = None,
    common: Annotated[
        bool,
        option(
            "Compare what both have; exit code 3 if anything is left out. Not for a gate.",
            None,
            "--common",
        ),
    ] = False,
    update: Annotated[
        bool, option("Accept the run: write the baseline's file from it.", None, "--update")
    ] = False,
) -> None:
    """Did my change make anything worse?

    Exit code 1 if so, 3 if too little can be compared, or --common leaves something out.
    """
    from attnwarp.errors import InputError
    from attnwarp_eval.canonical_json import write_json
    from attnwarp_eval.compare import compare
    from attnwarp_eval.compare.write import as_json, document
    from attnwarp_eval.document import write
    from attnwarp_eval.files import write_atomic

    with clear_errors():
        outputs = {"--markdown": markdown, "--json": json, "--html": html}
        _check_outputs(baseline, run, outputs, update)
        if update and common:
            raise InputError("--common: --update takes the whole run; leave one of the two out")
        if not update and baseline.is_dir() and run.is_dir() and baseline.samefile(run):
            raise InputError(f"{run}: is the baseline too, so nothing can differ; name two runs")
        measured, pictures, notes = _run(run)
        if update:
            _update(baseline, measured, pictures)
            return
        trusted, former_pictures = _baseline(baseline, measured, common)
        result = compare(trusted, measured, common)
        for note in notes:
            warn(note)
        if markdown is not None:
            write_atomic(markdown, write.markdown(document(result, notes)).encode())
        if html is not None:
            text = _page(result, trusted, measured, former_pictures, pictures, notes)
            write_atomic(html, text.encode())
        if json is not None:
            write_json(json, as_json(result, notes))
        _print(result)
    if result.incomplete:
        lacking = "; ".join(fault.name for fault in result.faults[:MOST_NAMED])
        more = len(result.faults) - MOST_NAMED
        log(
            f"{run}: lacks {lacking}{f' and {more} more' if more > 0 else ''}, which"
            f" {baseline} has; measure them, or compare what both have with --common"
        )
        raise Regression
    if result.regressed:
        accept = "accept it with --update"
        if baseline.is_dir():
            accept = f"name {run} in its place, or keep a file: BASELINE.jsonl {run} --update"
        log(f"{run}: a regression against {baseline}; if the change is meant, {accept}")
        raise Regression
    if result.too_little:
        raise fail(f"{run}: {result.too_little}", TOO_LITTLE)
    if result.left_out:
        raise fail(f"{run}: only what {baseline} has too was compared", TOO_LITTLE)


def _check_outputs(
    baseline: Path, run: Path, outputs: dict[str, Path | None], update: bool
) -> None:
    """Refuse outputs that cannot be written, or would overwrite inputs or each other."""
    from attnwarp.errors import InputError
    from attnwarp.io.file import check_other

    named = {option: path for option, path in outputs.items() if path is not None}
    if update and named:
        raise InputError(
            f"{next(iter(named))}: --update compares nothing that could be written there; compare"
            " first, then update"
        )
    first: dict[Path, str] = {}
    for name, path in named.items():
        check_other(path, baseline, "the baseline")
        for folder in (baseline, run):
            check_not_of_run(path, folder)
        other = first.setdefault(path.resolve(), name)
        if other != name:
            raise InputError(f"{name}: {path} is that of {other} too; name another file")


def _page(
    result: Comparison,
    trusted: Snapshot,
    run: Snapshot,
    before: Pictures,
    after: Pictures,
    notes: list[str],
) -> str:
    from attnwarp_eval.compare.pictures import largest_changes
    from attnwarp_eval.compare.write import page

    changes = largest_changes(trusted, run, before, after)
    lacking = [name for name, files in (("baseline", before), ("run", after)) if not files]
    if lacking:
        why_none = f"The {' and the '.join(lacking)} has no pictures."
    else:
        why_none = "No pictured view changed by more than the tolerance of a figure."
    return page(result, changes, why_none, notes)


def _run(folder: Path) -> tuple[Snapshot, Pictures, list[str]]:
    """A run, its pictures, and notes for the reader; its records, far larger, are freed."""
    from attnwarp.errors import InputError
    from attnwarp_eval.compare.pictures import pictures_of_run
    from attnwarp_eval.compare.snapshot import snapshot
    from attnwarp_eval.report import read_results
    from attnwarp_eval.study.store import Store

    store = Store(folder)
    results, done = read_results(store), store.done()
    # A damaged record says nothing of the code that is judged.
    damaged = [failure.error for failure in results.failures if failure.id in done]
    if damaged:
        raise InputError(damaged[0])
    return snapshot(results), pictures_of_run(results, folder), _of_other_code(results, folder)


def _of_other_code(results: Results, folder: Path) -> list[str]:
    """A warning if the run was computed by other code, about which it says nothing."""
    from attnwarp_eval.cost import environment
    from attnwarp_eval.study.record import Environment

    this = Environment.from_json(environment())
    records = results.all_records()
    other = sum(not record.environment.same_code(this) for record in records)
    if not other:
        return []
    return [
        f"{other} of the {len(records)} cells in {folder} were computed by other code than is here,"
        " so the comparison does not judge what is here; for that, run the study into a new folder"
    ]


def _baseline(path: Path, run: Snapshot, common: bool) -> tuple[Snapshot, Pictures]:
    """The baseline and its pictures; an unfinished one only for a comparison of common figures."""
    from attnwarp.errors import InputError
    from attnwarp_eval.compare import read_baseline
    from attnwarp_eval.compare.pictures import pictures_of_baseline
    from attnwarp_eval.compare.snapshot import snapshot
    from attnwarp_eval.report.raw import PARTS, read_parts, read_raw

    if path.name == "results.jsonl" and (path.parent / "study.json").is_file():
        path = path.parent  # a run's table of figures: the run has them all
    pictures: Pictures = {}
    raw = path.suffix == ".xz" and path.is_file()
    if raw or path.is_dir():
        if raw:
            trusted = snapshot(read_raw(path))
        elif any(path.glob(PARTS)):
            trusted = snapshot(read_parts(path))
        else:
            trusted, pictures, _ = _run(path)
        if trusted.missing and not common:
            raise InputError(
                f"{path}: {len(trusted.missing)} cells are missing, so it is no baseline; run its"
                " study again to measure them"
            )
    elif not path.exists():
        raise InputError(
            f"{path}: no such baseline; write it from a run that you trust with --update"
        )
    else:
        trusted = read_baseline(path)
        pictures = pictures_of_baseline(path, trusted)
    if trusted.study != run.study:
        raise InputError(
            f"{path}: a baseline of study {trusted.study!r}, expected {run.study!r} as the run's;"
            " name another baseline or run"
        )
    return trusted, pictures


def _update(path: Path, run: Snapshot, pictures: Pictures) -> None:
    """Write the baseline, and print the changes."""
    from attnwarp.errors import InputError
    from attnwarp_eval.compare import compare, read_baseline, write_baseline
    from attnwarp_eval.compare.pictures import write_pictures

    if path.is_dir():
        raise InputError(f"{path}: a folder, expected a baseline's file to write")
    if run.missing:
        raise fail(
            f"{path}: not written, as {len(run.missing)} cells of the run are missing; run the"
            " study again to measure them",
            TOO_LITTLE,
        )
    former = read_baseline(path) if path.exists() else None
    if former is not None and former.study != run.study:
        raise InputError(
            f"{path}: a baseline of study {former.study!r}, not written from a run of"
            f" {run.study!r}; name another file, or delete this one first"
        )
    before = path.read_bytes().splitlines()[1:] if former else []
    write_baseline(path, run)
    write_pictures(path, pictures)
    now = path.read_bytes().splitlines()[1:]
    if former is not None:
        _print(compare(former, run))
    new, gone = len(set(now) - set(before)), len(set(before) - set(now))
    typer.echo(f"{path}: {len(now)} lines; {new} are new or changed, {gone} are gone or changed")


def _print(comparison: Comparison) -> None:
    """Print the comparison on a terminal, or as plain lines without one."""
    from attnwarp_eval.compare.write import document, summary

    for section in document(comparison).sections:
        typer.echo(f"{section.title}:")
        for line in section.text:
            typer.echo(f"  {line}")
        for table in section.tables:
            for row in table.rows:
                named = zip(table.columns, row, strict=True)
                typer.echo("  " + _line(list(named)))
    typer.echo(summary(comparison))


def _line(cells: list[tuple[str, str]]) -> str:
    """A row of a table as a line that a log file can hold."""
    plain = ("what", "verdict", "probe", "variant", "metric", "name", "detail")
    return "  ".join(
        text if column in plain else f"{column} {text}" for column, text in cells if text
    )
