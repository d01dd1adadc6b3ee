"""Preferences from people's answers, and their report."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.numbers import number
from attnwarp_lab.userstudy.answers import Person
from attnwarp_lab.userstudy.preferences import (
    Agreement,
    Preferences,
    Share,
    agreement,
    preferences,
)

OVERALL = "overall"
"""Name of the total over all questions."""


@dataclass(frozen=True)
class Score:
    """Preferences of people.

    Attributes:
        title: title of the page.
        preferences: preferences by question, and over all.
        agreement: agreement by question, and over all.
        people: all people.
        failed: names of people who failed an attention check; their answers are excluded.
    """

    title: str
    preferences: Mapping[str, Preferences]
    agreement: Mapping[str, Agreement]
    people: Sequence[Person]
    failed: Sequence[str]

    def to_json(self) -> dict[str, Any]:
        """Plain values; null where undefined."""

        def shares(values: Mapping[Any, Share]) -> dict[str, Any]:
            return {
                " / ".join(key) if isinstance(key, tuple) else key: asdict(share)
                for key, share in values.items()
            }

        return dict(
            without_nan(
                {
                    "title": self.title,
                    "failed": list(self.failed),
                    "people": {
                        person.name: {
                            "choices": len(person.choices),
                            "planned": person.planned,
                            "checks": len(person.checks),
                            "failed": person.failed,
                        }
                        for person in self.people
                    },
                    "questions": {
                        name: {
                            "people": value.people,
                            "shares": shares(value.shares),
                            "pairs": shares(value.pairs),
                            "methods": list(value.methods),
                            "wins": value.wins.tolist(),
                            "selection_frequency": {
                                name: n / of if of else math.nan
                                for name, (n, of) in selection(value).items()
                            },
                            "agreement": asdict(self.agreement[name]),
                        }
                        for name, value in self.preferences.items()
                    },
                }
            )
        )


def score(people: Sequence[Person]) -> Score:
    """Preferences by question and overall, of people who passed all attention checks.

    Args:
        people: from :func:`attnwarp_lab.userstudy.answers.read_answers`.

    Raises:
        ValueError: no people or no choices are left.
    """
    failed = [person.name for person in people if person.failed]
    counted = [person for person in people if not person.failed and person.choices]
    if not counted:
        raise ValueError("no choices of people who passed every attention check")
    answers = [answer for person in counted for answer in person.choices]
    methods = sorted({name for answer in answers for name in answer.pair})
    questions = list(dict.fromkeys(answer.question for answer in answers))
    prefer, agree = {}, {}
    for name in (OVERALL, *sorted(questions)):
        own = {
            person.name: [a for a in person.choices if name in (OVERALL, a.question)]
            for person in counted
        }
        prefer[name] = preferences(
            {who: [answer.pair for answer in made] for who, made in own.items() if made}, methods
        )
        chosen: dict[object, list[str]] = {}
        for made in own.values():
            for answer in made:
                chosen.setdefault(answer.comparison, []).append(answer.pair[0])
        agree[name] = agreement(chosen)
    return Score(people[0].title, prefer, agree, people, failed)


def report(result: Score) -> Report:
    """Report of the score."""
    counted = [p for p in result.people if p.name not in result.failed and p.choices]
    whole = result.preferences[OVERALL]
    made = sum(len(p.choices) for p in counted)
    lead = [
        f"{len(counted)} {'person' if len(counted) == 1 else 'people'} made {made}"
        f" choice{'s' * (made != 1)} between {len(whole.methods)} methods."
    ]
    if result.failed:
        lead.append(f"**Left out, as they failed an attention check: {', '.join(result.failed)}.**")
    if len(counted) < 2:
        lead.append("Answers of one person have no intervals.")
    return Report(
        f"Preferences: {result.title}",
        lead,
        [
            _shares(result),
            _frequencies(result),
            _method_pairs(whole),
            _agreement(result),
            _people(result),
        ],
    )


def _shares(result: Score) -> Section:
    whole = result.preferences[OVERALL]
    names = sorted(whole.methods, key=lambda name: -_known(whole.shares[name].value))
    rows = [
        [name, *(_text(value.shares[name]) for value in result.preferences.values())]
        for name in names
    ]
    text = [
        "Probability that a method is chosen over another one (mean over the others, Bradley-Terry"
        " model), with 95 % intervals of a bootstrap over people. 0.5 is no preference. The"
        " intervals speak of other people, on these scenes and pictures."
    ]
    text += [
        f"**Question {name!r}: no chain of choices connects {', '.join(value.unconnected)} with the"
        " others.**"
        for name, value in result.preferences.items()
        if value.unconnected
    ]
    return Section("Preferences", text, [Table(["method", *result.preferences], rows)])


def selection(value: Preferences) -> dict[str, tuple[int, int]]:
    """Times that each method was chosen, and was shown.

    Example:
        >>> from attnwarp_lab.userstudy.preferences import preferences
        >>> selection(preferences({"one": [("a", "b"), ("a", "c"), ("b", "a")]}, ["a", "b", "c"]))
        {'a': (2, 3), 'b': (1, 2), 'c': (0, 1)}
    """
    wins = value.wins
    return {
        name: (int(wins[k].sum()), int(wins[k].sum() + wins[:, k].sum()))
        for k, name in enumerate(value.methods)
    }


def _frequencies(result: Score) -> Section:
    columns = {name: selection(value) for name, value in result.preferences.items()}
    chosen = columns[OVERALL]
    names = sorted(chosen, key=lambda name: -chosen[name][0] / max(1, chosen[name][1]))
    rows = [
        [name, *(f"{n / of:.0%} of {of}" if of else "–" for n, of in own)]
        for name in names
        for own in [[column[name] for column in columns.values()]]
    ]
    text = [
        "How often a method was chosen when it was one of the two, as user studies of the field"
        " report it. It depends on what a method was shown against; the preferences above do not."
    ]
    return Section("Selection frequency", text, [Table(["method", *columns], rows)])


def _method_pairs(whole: Preferences) -> Section:
    place = {name: k for k, name in enumerate(whole.methods)}
    rows = []
    for (a, b), share in whole.pairs.items():
        for_a, for_b = (int(whole.wins[place[x], place[y]]) for x, y in ((a, b), (b, a)))
        rows.append([a, b, f"{for_a} of {for_a + for_b}", _text(share), _verdict(share, a, b)])
    text = [
        "All questions together. The probability is the model's, which also uses choices against"
        " other methods; its intervals hold for all pairs together at 95 % (Sidak)."
    ]
    columns = ["method", "against", "chosen", "probability", "verdict"]
    return Section("Method against method", text, [Table(columns, rows)])


def _agreement(result: Score) -> Section:
    rows = [
        [name, number(value.share), number(value.kappa), str(value.comparisons)]
        for name, value in result.agreement.items()
    ]
    text = [
        "Share of pairs of people who chose alike in the same comparison; kappa is the share above"
        " chance, 2 share - 1. Kappa near 0: people's tastes differ, or they cannot tell."
    ]
    columns = ["question", "chose alike", "kappa", "comparisons judged by several"]
    return Section("Agreement between people", text, [Table(columns, rows)])


def _people(result: Score) -> Section:
    rows = []
    for person in result.people:
        seconds = [answer.seconds for answer in person.choices]
        left = [answer.chosen == "left" for answer in person.choices]
        rows.append(
            [
                person.name,
                f"{len(person.choices) + len(person.checks)} of {person.planned}",
                f"{person.failed} of {len(person.checks)}",
                "no" if person.name in result.failed or not person.choices else "yes",
                number(statistics.median(seconds) if seconds else math.nan),
                number(sum(left) / len(left) if left else math.nan),
            ]
        )
    columns = ["person", "answered", "checks failed", "counts", "median seconds", "share left"]
    text = ["Sides are balanced, so somebody who prefers a side favours no method."]
    return Section("People", text, [Table(columns, rows)])


def _verdict(share: Share, a: str, b: str) -> str:
    if share.low > 0.5:
        return f"{a} preferred"
    if share.high < 0.5:
        return f"{b} preferred"
    return "can't tell"


def _text(share: Share) -> str:
    if not math.isfinite(share.value):
        return "–"
    if not math.isfinite(share.low):
        return f"{share.value:.2f}"
    return f"{share.value:.2f} [{share.low:.2f}, {share.high:.2f}]"


def _known(value: float) -> float:
    return value if math.isfinite(value) else -1.0
