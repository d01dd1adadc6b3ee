"""A run's report: report.md, report.html (self-contained) and results.jsonl, made from its cells
alone.
"""

from __future__ import annotations

from pathlib import Path

from attnwarp_eval.document.write import write_files
from attnwarp_eval.files import write_atomic
from attnwarp_eval.report.build import build, problems
from attnwarp_eval.report.results import lines, read_results
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.store import Store, StoreError

__all__ = ["problems", "read_results", "write_report"]


def write_report(store: Store, *, timings: bool = True, pictures: bool = True) -> list[Path]:
    """Write the report of a run's folder, from whatever cells are done.

    Args:
        store: the run.
        timings: False leaves out everything measured in seconds or memory, so that two runs of the
            same study on the same code give the same bytes.
        pictures: False leaves out the views' pictures, for a report that lies beside the code or
            in a CI summary.

    Returns:
        The files written, the one a person opens first at the end.

    Raises:
        StoreError: the folder is no run, or a picture is not the one that was written.

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
    store.refuse_links()
    results = read_results(store)
    if pictures:
        _check_pictures(results, store)
    report = build(results, store.root, timings=timings, pictures=pictures)
    path = store.root / "results.jsonl"
    write_atomic(path, _content(results, timings))
    return [path, *write_files(report, store.root, "report")]


def wrong_results(store: Store) -> list[str]:
    """What is wrong with the ``results.jsonl`` of a whole run, one line; it may not be there yet.

    Args:
        store: the run.
    """
    path = store.root / "results.jsonl"
    if not path.is_file():
        return []
    results, there = read_results(store), path.read_bytes()
    if any(there == _content(results, timings) for timings in (True, False)):
        return []
    return [
        f"{path.name}: is not what the cells give; attnwarp-eval report {store.root} writes it anew"
    ]


def _content(results: Results, timings: bool) -> bytes:
    return "".join(f"{line}\n" for line in lines(results, timings)).encode()


def _check_pictures(results: Results, store: Store) -> None:
    pictures = (p for cell in results.cells if cell.record for p in cell.record.pictures)
    damaged = store.damaged_pictures(picture.to_json() for picture in pictures)
    if damaged:
        others = f" (and {len(damaged) - 1} more)" if len(damaged) > 1 else ""
        raise StoreError(f"{damaged[0]}{others}; --no-pictures writes the report without them")
