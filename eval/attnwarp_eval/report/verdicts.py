"""Table of verdicts from the raw results of all studies, and the lines of README.md from it."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from attnwarp.errors import InputError
from attnwarp_eval.document.model import Table
from attnwarp_eval.document.numbers import number as rounded
from attnwarp_eval.document.numbers import ratio_text
from attnwarp_eval.document.write import markdown_table
from attnwarp_eval.report.claims import Claim, load_claims
from attnwarp_eval.report.judging import (
    COLUMNS,
    Comparison,
    claim_row,
    claim_verdict,
    judged,
    means_in_words,
    measured,
)
from attnwarp_eval.report.raw import PARTS, read_raw, together
from attnwarp_eval.statistics.intervals import time_ratio
from attnwarp_eval.study.probe_report import report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.turns import Timed, timed_in_turn

TABLE, LINES = "verdicts", "headlines"
"""Marks of the blocks replaced by :func:`filled`: ``<!-- verdicts -->`` and its end."""


@dataclass(frozen=True)
class Judged:
    """Claim with its verdict over all studies.

    Attributes:
        comparison: its comparison with a word; None if its study has no raw results, or lacks a
            side.
        time: ratio of the last side's seconds to the first one's, taken in turn, and the number of
            scenes that were timed; a dash without.
    """

    claim: Claim
    comparison: Comparison | None = None
    time: str = "–"
    report: Path | None = None
    seeds: int = 1


def verdicts(folder: Path) -> list[Judged]:
    """Every claim with its verdict by a folder of reports, p-values adjusted over all studies.

    Raises:
        InputError: raw results are unreadable or of different studies.
    """
    parts: dict[str, list[tuple[Path, Results]]] = defaultdict(list)
    for path in sorted(folder.rglob(PARTS)):
        results = read_raw(path)
        if any(claim.study == results.study.name for claim in load_claims()):
            parts[results.study.name].append((path, results))
    studies: dict[str, tuple[Path, Results]] = {}
    for name, own in parts.items():
        folders = {path.parent for path, _ in own}
        if len(folders) > 1:
            raise InputError(
                f"study {name}: raw results lie in {', '.join(map(str, sorted(folders)))}; keep"
                " those of one run"
            )
        studies[name] = (*folders, together([results for _, results in own]))  # type: ignore[assignment]
    by_claim = {
        one.claim.id: one
        for one in judged(
            one
            for _, results in studies.values()
            for one in measured(results, [c for c in load_claims() if _judges(results, c)])
        )
        if one.claim is not None
    }
    return [_judged(claim, by_claim.get(claim.id), studies) for claim in load_claims()]


def _judges(results: Results, claim: Claim) -> bool:
    """Return True if these are results of the study and the scenes that were declared."""
    drawn = results.study.population
    of = claim.scenes
    same = drawn is not None and of is not None and drawn.seed == of["seed"]
    return same and claim.study == results.study.name


def _judged(
    claim: Claim, one: Comparison | None, studies: Mapping[str, tuple[Path, Results]]
) -> Judged:
    if one is None:
        return Judged(claim)
    folder, results = studies[claim.study]
    return Judged(claim, one, _time(results, one), folder, len(results.study.seeds))


def _time(results: Results, one: Comparison) -> str:
    timed, names = timed_in_turn(results, report_of(one.probe).stage), {one.a, one.b}
    both = [turn for turn in timed.turns if names <= set(turn.names)] if timed else []
    if timed is None or not both or len(names) < 2:
        return "–"
    own = Timed(both, timed.stage)
    first, second = (own.rounds(name) for name in (one.a, one.b))
    return f"{ratio_text(time_ratio(second, first))}, {own.scenes} scene{'s' * (own.scenes != 1)}"


def table(claims: list[Judged], beside: Path) -> Table:
    """The table of all claims, with links relative to the folder ``beside``."""
    rows = []
    for each in claims:
        one = each.comparison
        if one is None or each.report is None:
            absent = f"not measured: `{each.claim.study}` judges it"
            rows.append([each.claim.text, absent, *["–"] * len(COLUMNS)])
            continue
        link = Path(os.path.relpath(each.report / "report.md", beside)).as_posix()
        row = claim_row(one, each.seeds)
        rows.append([*row, each.time, f"[{each.claim.study}]({link})"])
    return Table([*COLUMNS, "time", "report"], rows)


def headlines(claims: list[Judged]) -> list[str]:
    """Lines of the claims that README.md names, in their order, those of one number in one line;
    none if none was judged.
    """
    chosen = sorted(
        (each for each in claims if each.claim.headline), key=lambda each: each.claim.headline
    )
    lines: dict[int, list[str]] = {}
    for each in chosen:
        if (one := each.comparison) is None:
            continue
        verdict, why = claim_verdict(one), one.reason
        if verdict == "blind":
            why = "features from a wrong place do as well"
        reason = f" ({why})" if why else ""
        text = each.claim.plain or each.claim.text
        difference = f"{_plainly(one)}, over {one.contrast.scenes} scenes"
        told = f"{verdict[0].upper()}{verdict[1:]}{reason}: {difference}."
        lines.setdefault(each.claim.headline, []).append(f"**{text}.** {told}")
    return [f"{number}. {' '.join(told)}" for number, told in enumerate(lines.values(), 1)]


def _plainly(one: Comparison) -> str:
    """Difference in plain words: shares side by side, errors in percent or as a factor."""
    factor, _, _ = one.contrast.shown()
    if one.contrast.scale != "ratio":
        return means_in_words(one)
    if factor > 2:
        return f"{rounded(factor, 2)} times the error"
    return f"{rounded(100 * abs(factor - 1), 2)} % {'less' if factor < 1 else 'more'} error"


def filled(text: str, claims: list[Judged], beside: Path) -> str:
    """Fill a document's marked places with the table and the lines; lines stay as they are while
    none of their claims has raw results.

    Example:
        >>> filled("<!-- headlines -->\\nas before\\n<!-- /headlines -->\\n", [], Path())
        '<!-- headlines -->\\nas before\\n<!-- /headlines -->\\n'
    """
    blocks = {
        TABLE: markdown_table(table(claims, beside)).strip("\n"),
        LINES: "\n".join(headlines(claims)),
    }
    for mark, content in blocks.items():
        before, begun, rest = text.partition(_begin(mark))
        _, ended, after = rest.partition(_end(mark))
        if content and begun and ended:
            text = f"{before}{begun}{content}\n{ended}{after}"
    return text


def marked(text: str) -> bool:
    """Return True if a document has marks for the table or the lines."""
    return any(_begin(mark) in text and _end(mark) in text for mark in (TABLE, LINES))


def _begin(mark: str) -> str:
    return f"<!-- {mark} -->\n"


def _end(mark: str) -> str:
    return f"<!-- /{mark} -->"
