"""Selection frequency of methods from people's answers, and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.numbers import bracketed
from attnwarp_eval.statistics.intervals import Interval, interval
from attnwarp_lab.userstudy.answers import Person

OVERALL = "overall"
"""Name of the total over all questions."""


@dataclass(frozen=True)
class Score:
    """Choices of people.

    Attributes:
        title: title of the page.
        counted: people whose answers count.
        failed: names of people who failed an attention check; their answers are excluded.
        frequency: question, or all -> method -> share of the times it was shown in which a person
            chose it, mean over people with its 95 % interval.
    """

    title: str
    counted: Sequence[Person]
    failed: Sequence[str]
    frequency: Mapping[str, Mapping[str, Interval]]


def score(people: Sequence[Person]) -> Score:
    """Selection frequency by question and overall, of people who passed all attention checks.

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
    frequency = {
        question: {
            method: interval(
                {
                    person.name: [
                        float(answer.pair[0] == method)
                        for answer in person.choices
                        if question in (OVERALL, answer.question) and method in answer.pair
                    ]
                    for person in counted
                }
            )
            for method in methods
        }
        for question in (OVERALL, *sorted({answer.question for answer in answers}))
    }
    return Score(people[0].title, counted, failed, frequency)


def report(result: Score) -> Report:
    """Report of the score."""
    count, made = len(result.counted), sum(len(p.choices) for p in result.counted)
    overall = result.frequency[OVERALL]
    lead = [
        f"{count} {'person' if count == 1 else 'people'} made {made} choice{'s' * (made != 1)}"
        f" between {len(overall)} methods."
    ]
    if result.failed:
        lead.append(f"**Left out, as they failed an attention check: {', '.join(result.failed)}.**")
    names = sorted(overall, key=lambda name: -overall[name].mean)
    rows = [[name, *(_text(own[name]) for own in result.frequency.values())] for name in names]
    text = [
        "How often a method was chosen when it was one of the two, mean over people, with 95 %"
        " intervals that hold for other people on these scenes. 0.5 is no preference. It depends on"
        " what a method was shown against."
    ]
    table = Table(["method", *result.frequency], rows)
    return Report(
        f"Preferences: {result.title}", lead, [Section("Selection frequency", text, [table])]
    )


def _text(share: Interval) -> str:
    """A share with its interval, if several people chose, and the times it was shown."""
    if not share.views:
        return "–"
    return f"{bracketed(share.mean, share.low, share.high)} of {share.views}"
