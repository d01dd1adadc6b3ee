"""Commands that run a study, check a run, and write its report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import fail, log, warn
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import (
    TOO_LITTLE,
    clear_errors,
    names,
    resumable,
    scheduler_lost,
    whole_numbers,
)

if TYPE_CHECKING:
    from attnwarp_eval.study.cell import Cell
    from attnwarp_eval.study.results import Results
    from attnwarp_eval.study.run import Plan, Summary
    from attnwarp_eval.study.schema import Study
    from attnwarp_eval.study.store import Store


def run(
    study: Annotated[
        str, typer.Argument(help="Study that ships, such as quick, or the path of a study's YAML.")
    ] = "quick",
    out: Annotated[
        Path | None,
        option(
            "Write the run to this folder, or go on with the run in it (default runs/STUDY).",
            "FOLDER",
        ),
    ] = None,
    jobs: Annotated[
        int, option("Compute in so many processes, at most one a core.", "N", "--jobs", "-j", min=1)
    ] = 1,
    scheduler: Annotated[
        str | None,
        option(
            "Compute on the workers of this dask scheduler, tcp://HOST:PORT or its file.",
            "ADDRESS|FILE",
        ),
    ] = None,
    scenes: Annotated[
        str | None,
        option("Measure these scenes alone, with commas between names or paths.", "NAMES"),
    ] = None,
    seeds: Annotated[
        str | None, option("Take these seeds in place of the study's, such as 0,1,2.", "SEEDS")
    ] = None,
    size: Annotated[
        int | None,
        option(
            "Render pictures of so many px a side in place of the study's.", "PX", min=16, max=4096
        ),
    ] = None,
    keep_going: Annotated[
        bool, option("Go on after a failed cell, or stop at it.", None, "--keep-going/--fail-fast")
    ] = True,
    dry_run: Annotated[
        bool,
        option(
            "Measure nothing; list the cells, and the hours and scenes they need.",
            None,
            "--dry-run",
        ),
    ] = False,
) -> None:
    """Run a study and write its report.

    Killed half-way and started again, it goes on where it was.
    """
    from attnwarp_eval.study.study import load_study

    def load() -> Study:
        return load_study(study, scenes=names(scenes), seeds=drawn, size=size)

    drawn = whole_numbers(seeds, "--seeds")
    if scheduler is not None and jobs > 1:
        raise fail("--jobs starts workers here, --scheduler uses others; give one of the two")
    if dry_run:
        _print_plan(load, out)
    else:
        run_study(load, out, jobs, scheduler, keep_going)


def _print_plan(load: Callable[[], Study], out: Path | None) -> None:
    """Print a study's cells by probe and variant, and the number of finished ones."""
    from rich.console import Console

    from attnwarp_eval.document.model import Table
    from attnwarp_eval.document.write import terminal
    from attnwarp_eval.study.run import plan
    from attnwarp_eval.study.store import Store

    with clear_errors():
        loaded = load()
        store = Store(out or Path("runs") / loaded.name)
        store.refuse_strangers()
        planned = plan(loaded, store)
    todo = {cell.id for cell in planned.todo}
    rows: dict[tuple[str, str], list[bool]] = {}
    for cell in planned.cells:
        rows.setdefault((cell.probe, _who(cell)), []).append(cell.id not in todo)
    table = Table(
        ["probe", "variant", "cells", "done"],
        [[*key, str(len(done)), str(sum(done))] for key, done in rows.items()],
    )
    Console().print(terminal(table))
    scenes = f"{loaded.scenes_in_words}; " if loaded.scenes else ""
    _name_untabulated(loaded)
    _name_notices(planned)
    _name_computed_once(planned)
    typer.echo(
        f"study {loaded.name}: {scenes}seeds {', '.join(map(str, loaded.seeds))};"
        f" {len(planned.cells)} cells, {planned.reused} done in {store.root}"
    )

    _print_needed(store)


def _print_needed(store: Store) -> None:
    """Print, from finished cells, the scenes that each claim needs."""
    from rich.console import Console

    from attnwarp_eval.document.write import terminal
    from attnwarp_eval.report import read_results
    from attnwarp_eval.report.planning import plan_scenes

    if not (store.root / "study.json").is_file():
        return
    if (table := plan_scenes(read_results(store))).rows:
        Console(width=150).print(terminal(table))
        typer.echo(
            "so many scenes tell the difference of interest in 80 % of studies, by one test at 5 %;"
            " more are needed where many claims are adjusted for"
        )


def _name_notices(planned: Plan) -> None:
    """Print the notices on the scenes, which the report also has."""
    for scene, lines in planned.notices.items():
        for line in lines:
            warn(f"scene {scene}: {line}")


def _name_computed_once(planned: Plan) -> None:
    """Print the variants that are one computation, which the report also has."""
    from attnwarp_eval.study.computations import alike

    for name, labels in alike((cell.probe, cell.labels) for cell in planned.cells):
        log(f"one computation, so equal rows of {name}: {', '.join(labels)}")


def _name_untabulated(study: Study) -> None:
    """Print the measured variants that no table or front of the report shows."""
    from attnwarp_eval.study.probe_report import report_of

    tabulated = {(a.probe, name) for a in study.ablations for name in (a.baseline, *a.variants)}
    tabulated |= {(front.probe, name) for front in study.fronts for name in front.variants}
    untabulated = {
        name: [variant for variant in variants if (name, variant) not in tabulated]
        for name, variants in study.probes.items()
        if (own := report_of(name)).probe.tabled and not own.tabulates_all
    }
    listed = "; ".join(f"{name} of {', '.join(rest)}" for name, rest in untabulated.items() if rest)
    if listed:
        log(
            f"in no table of the report: {listed}; a table under 'ablations' shows"
            " them, results.jsonl has them anyway"
        )


def _who(cell: Cell) -> str:
    """The variants of a cell: names of one content, or variants timed in turn."""
    if cell.labels and cell.variant not in cell.labels:
        return f"{', '.join(cell.labels)} (in turn)"
    return " = ".join(cell.labels) or cell.variant


def run_study(
    load: Callable[[], Study],
    out: Path | None,
    jobs: int = 1,
    scheduler: str | None = None,
    keep_going: bool = True,
) -> Results:
    """Run a study and write its report; return the results.

    Args:
        load: function that reads the study, with one-line errors.
        out: the run's folder; ``runs/<study>`` if None.
        jobs: worker processes.
        scheduler: address or file of a dask scheduler, whose workers compute instead.
        keep_going: whether to continue after a failed cell.
    """
    from attnwarp_eval.cache import limit_bytes
    from attnwarp_eval.report import problems, read_results, write_report
    from attnwarp_eval.study.run import plan
    from attnwarp_eval.study.store import Store

    with clear_errors():
        limit_bytes()  # an invalid limit would make every cell fail
        loaded = load()
        store = Store(out or Path("runs") / loaded.name)
        store.refuse_strangers()
        _name_untabulated(loaded)
        with resumable(lambda: f"{len(store.done())} cells are kept"):
            planned = plan(loaded, store)
            _name_notices(planned)
            _name_computed_once(planned)
            with store.lock():
                if planned.other_code:
                    log(
                        f"{planned.other_code} of the cells in {store.root} were"
                        " computed by other code than this; they are kept, and the report names"
                        " it. To judge this code, name another folder with --out."
                    )
                others = len(store.done() - {cell.id for cell in planned.cells})
                if others:
                    log(
                        f"{others} of the cells in {store.root} are of other sizes,"
                        " scenes, seeds or settings than this run; they are kept, and the report is"
                        " of this run alone. Name another folder with --out to keep the former."
                    )
                with scheduler_lost(scheduler, lambda: len(store.done())):
                    summary = _watch(planned, store, jobs, scheduler, keep_going)
                results = read_results(store)
                _print_answer(results)
                for path in write_report(store):
                    typer.echo(path)
                uncalibrated = problems(results)
    _print_failures(summary)
    if not summary.complete:
        missing = summary.expected - summary.reused - summary.computed
        raise fail(
            f"{missing} of {summary.expected} cells were not measured; run again to retry them",
            TOO_LITTLE,
        )
    if uncalibrated:
        raise fail("the instrument is not calibrated: " + "; ".join(uncalibrated), TOO_LITTLE)
    return results


def _watch(
    planned: Plan, store: Store, jobs: int, scheduler: str | None, keep_going: bool
) -> Summary:
    """Run with a progress bar on a terminal, or one line per cell without one."""
    from attnwarp_eval.study.run import execute

    with reporter(every=True) as report:
        reused = f", {planned.reused} already done" if planned.reused else ""
        report.log(
            f"study {planned.study.name}: {len(planned.cells)} cells{reused} -> {store.root}"
        )
        return execute(
            planned, store, jobs=jobs, scheduler=scheduler, keep_going=keep_going, report=report
        )


def _print_failures(summary: Summary) -> None:
    if not summary.failures:
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("scene", "variant", "probe", "error", title="failed cells")
    for failure in summary.failures:
        table.add_row(failure.scene, failure.variant, failure.probe, failure.error)
    Console(stderr=True).print(table)


def _print_answer(results: Results) -> None:
    """Print the report's answer on the terminal: sentences, and one table."""
    from rich.console import Console

    from attnwarp_eval.document.write import terminal
    from attnwarp_eval.report.answer import answer
    from attnwarp_eval.report.claims import load_claims
    from attnwarp_eval.report.judging import claims_section, judge

    section = answer(results) or claims_section(results, judge(results, load_claims()))
    if section is None:
        return
    console = Console(highlight=False)
    for line in section.text:
        console.print(line.replace("**", "").replace("`", ""), markup=False)
    for table in section.tables:
        rows = [[cell.replace("**", "").replace("`", "") for cell in row] for row in table.rows]
        console.print(terminal(replace(table, rows=rows)))


def report(
    run: Annotated[
        Path, typer.Argument(help="The run's folder, or one of raw results (results*.jsonl.xz).")
    ],
    timings: Annotated[
        bool, option("Show seconds; two reports without any can be compared.")
    ] = True,
    pictures: Annotated[bool, option("Show pictures beside tables and figures.")] = True,
    long: Annotated[
        bool, option("Write every table to report.md in place of one page.", None, "--long")
    ] = False,
    out: Annotated[
        Path | None,
        option("Write the report here, without pictures of views (default RUN).", "FOLDER"),
    ] = None,
    raw: Annotated[
        Path | None,
        option(
            "Write the compressed raw results here too, which verdicts and compare read.",
            "FOLDER|FILE",
        ),
    ] = None,
    latex: Annotated[
        bool,
        option(
            "Write every table to tables/*.tex, captioned by what was measured.", None, "--latex"
        ),
    ] = False,
    csv: Annotated[
        bool,
        option("Write every table to tables/*.csv, its caption first, after #.", None, "--csv"),
    ] = False,
) -> None:
    """Make report.md, report.html and results.jsonl again from the cells of a run.

    report.md is one page: the answer, the claims, a table for each group of variants.
    report.html has all other tables too, folded. Raw results of a study's parts, as reports/ has
    them, make one report.md and report.html, without pictures.
    """
    from attnwarp_eval.report import read_results, write_report, write_report_of_parts
    from attnwarp_eval.report.raw import PARTS, write_raw
    from attnwarp_eval.study.store import Store

    tables = ("tex",) * latex + ("csv",) * csv
    with clear_errors():
        if raw is None and not (run / "study.json").exists() and any(run.glob(PARTS)):
            for path in write_report_of_parts(
                run, out=out, timings=timings, long=long, tables=tables
            ):
                typer.echo(path)
            return
        store = Store(run)
        for path in write_report(
            store, out=out, timings=timings, pictures=pictures, long=long, tables=tables
        ):
            typer.echo(path)
        results = read_results(store)
        if raw is not None:
            typer.echo(write_raw(store, raw))
    missing = len(results.cells) - results.measured
    if results.failures:
        raise fail(
            f"{run}: {len(results.failures)} of {len(results.cells)} cells failed or are damaged,"
            f" {missing} have no figures in the report; attnwarp-eval verify {run} names them",
            TOO_LITTLE,
        )
    if not results.measured:
        raise fail(
            f"{run}: none of {len(results.cells)} cells was measured; run the study again to"
            " measure them",
            TOO_LITTLE,
        )
    if missing:
        log(
            f"{run}: {missing} of {len(results.cells)} cells are missing, as the run"
            f" is unfinished; attnwarp-eval verify {run} names them"
        )


def verdicts(
    folder: Annotated[
        Path, typer.Argument(help="Folder of reports, with results*.jsonl.xz beside each.")
    ] = Path("reports"),
    write: Annotated[
        list[Path] | None,
        option("Write the table and lines anew in this document; may be repeated.", "FILE"),
    ] = None,
) -> None:
    """Judge every claim by the raw results of its study, all adjusted together.

    The table replaces what stands between <!-- verdicts --> and <!-- /verdicts --> in a document,
    the lines of the headline claims what stands between <!-- headlines --> and
    <!-- /headlines -->.
    """
    from attnwarp.errors import InputError
    from attnwarp.io.text import read_text
    from attnwarp_eval.document.write import markdown_table
    from attnwarp_eval.files import write_atomic
    from attnwarp_eval.report import verdicts as all_studies

    with clear_errors():
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; name that of the reports")
        judged = all_studies.verdicts(folder)
        for path in write or []:
            text = read_text(path)
            made = all_studies.filled(text, judged, path.parent)
            if not all_studies.marked(text):
                raise InputError(
                    f"{path}: has no place for verdicts; put <!-- verdicts --> and"
                    " <!-- /verdicts --> where the table belongs"
                )
            write_atomic(path, made.encode())
            typer.echo(path)
    if not write:
        typer.echo(markdown_table(all_studies.table(judged, folder)))
    if not any(each.comparison for each in judged):
        raise fail(
            f"{folder}: holds no raw results of a study that judges a claim; write them with"
            " attnwarp-eval report RUN --raw FOLDER",
            TOO_LITTLE,
        )


def verify(run: Annotated[Path, typer.Argument(help="The run's folder.")]) -> None:
    """Check that a run is whole and undamaged.

    The hashes of its cells and pictures are computed again, and the expected cells listed again.
    """
    from attnwarp_eval.study.run import verify
    from attnwarp_eval.study.store import Store

    with clear_errors():
        problems = verify(Store(run))
    for what, items in (
        ("damaged", problems.damaged),
        ("failed", problems.failed),
        ("missing", problems.missing),
        ("not of this study (kept)", problems.unexpected),
    ):
        for item in items:
            typer.echo(f"{what}: {item}")
    if not problems.ok:
        bad = len(problems.damaged) + len(problems.failed) + len(problems.missing)
        raise fail(
            f"{run}: {bad} problem{'s' * (bad != 1)} in {problems.checked}"
            f" cell{'s' * (problems.checked != 1)}; run the study again to mend"
            f" {'it' if bad == 1 else 'them'}",
            TOO_LITTLE,
        )
    typer.echo(f"{run}: {problems.checked} cells, every hash fits, none is missing")


def studies() -> None:
    """List the studies that ship with the package."""
    from attnwarp_eval.study.study import load_study, shipped_studies

    with clear_errors():
        names = list(shipped_studies())
        for name in names:
            typer.echo(f"{name:{max(map(len, names))}}  {load_study(name).title}")
