"""Report of a run: report.md, report.html (self-contained) and results.jsonl, made from its cells
only.
"""

from __future__ import annotations

import functools
from pathlib import Path

from attnwarp_eval.document.model import Report
from attnwarp_eval.document.tables import write_tables
from attnwarp_eval.document.write import write_files
from attnwarp_eval.files import write_atomic
from attnwarp_eval.report.build import build, problems
from attnwarp_eval.report.measured import regime
from attnwarp_eval.report.raw import read_parts
from attnwarp_eval.report.results import lines, read_results
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.store import Store, StoreError

__all__ = ["problems", "read_results", "write_report", "write_report_of_parts"]


def write_report(
    store: Store,
    *,
    out: Path | None = None,
    timings: bool = True,
    pictures: bool = True,
    long: bool = False,
    tables: tuple[str, ...] = (),
) -> list[Path]:
    """Write the report of a run's folder from its finished cells.

    Args:
        out: folder of the report, by default the run's; another one gets no pictures of views.
        timings: False leaves out measured seconds and memory, so that two runs of the
            same study on the same code give the same bytes.
        pictures: False leaves out the views' pictures, for a report stored with the code or
            in a CI summary.
        long: whether report.md has the folded sections and tables of report.html.
        tables: endings of files ("tex", "csv") that every table gets, in the folder ``tables``.

    Returns:
        The written files; the last is the one to open first.

    Raises:
        StoreError: the folder is not a run, or a picture has changed since it was written.

    Example:
        >>> from attnwarp_eval.study import Store, parse_study
        >>> from attnwarp_eval.study.run import expected, plan
        >>> content = dict(name="my", scenes=["spheres"], variants={"a": {}})
        >>> study = parse_study(content | {"probes": {"depth": ["a"]}})
        >>> store = Store("run")
        >>> store.write_study(expected(plan(study, store)))
        >>> [path.name for path in write_report(store)]
        ['results.jsonl', 'report.md', 'report.html']
    """
    results = read_results(store)
    folder = out or store.root
    if shown := pictures and out is None:
        _check_pictures(results, store)
    report = build(results, folder, timings=timings, pictures=shown)
    path = folder / "results.jsonl"
    write_atomic(path, "".join(f"{line}\n" for line in lines(results, timings)).encode())
    return [path, *_written(report, results, folder, long, tables)]


def write_report_of_parts(
    folder: Path, *, out: Path | None = None, timings: bool = True, long: bool = False,
    tables: tuple[str, ...] = (),
) -> list[Path]:  # fmt: skip
    """Write the report of a folder of raw results, without the views' pictures.

    Args:
        folder: path of ``results*.jsonl.xz``, parts of one study.
        out: folder of the report, by default that of the raw results.
        timings, long, tables: as for :func:`write_report`.

    Returns:
        The written files; the last is the one to open first.

    Raises:
        InputError: raw results are unreadable or of different studies.

    Example:
        >>> from attnwarp_eval.report.raw import write_raw
        >>> from attnwarp_eval.study import Store, parse_study
        >>> from attnwarp_eval.study.run import expected, plan
        >>> content = dict(name="my", scenes=["spheres"], variants={"a": {}})
        >>> study = parse_study(content | {"probes": {"depth": ["a"]}})
        >>> store = Store("run")
        >>> store.write_study(expected(plan(study, store)))
        >>> folder = write_raw(store, Path("reports")).parent
        >>> [path.name for path in write_report_of_parts(folder)]
        ['report.md', 'report.html']
    """
    results, out = read_parts(folder), out or folder
    report = build(results, out, timings=timings, pictures=False)
    return _written(report, results, out, long, tables)


def _written(
    report: Report, results: Results, folder: Path, long: bool, tables: tuple[str, ...]
) -> list[Path]:
    regime_of = functools.partial(regime, results)
    made = write_tables(report, regime_of, folder / "tables", tables) if tables else []
    return [*made, *write_files(report, folder, "report", long=long)]


def _check_pictures(results: Results, store: Store) -> None:
    pictures = (p for cell in results.cells if cell.record for p in cell.record.pictures)
    damaged = store.damaged_pictures(picture.to_json() for picture in pictures)
    if damaged:
        others = f" (and {len(damaged) - 1} more)" if len(damaged) > 1 else ""
        raise StoreError(f"{damaged[0]}{others}; --no-pictures writes the report without them")
