"""Draw of each person's choices, their order and their sides: by a seed, balanced."""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace

SCRAMBLED = "(scrambled)"
"""The worse side of an attention check: a method's pictures with their parts moved
around."""


@dataclass(frozen=True)
class Choice:
    """One two-way choice.

    Attributes:
        item: number of the edited scene.
        question: name of the question.
        left, right: methods; one is :data:`SCRAMBLED` in an attention check.
    """

    item: int
    question: str
    left: str
    right: str

    @property
    def is_check(self) -> bool:
        """True if it is an attention check."""
        return SCRAMBLED in (self.left, self.right)

    def mirrored(self) -> Choice:
        """Choice with its sides exchanged."""
        return replace(self, left=self.right, right=self.left)


def draw(
    methods: Sequence[Sequence[str]],
    questions: Sequence[str],
    *,
    plans: int,
    choices: int,
    checks: int,
    seed: int,
) -> list[list[Choice]]:
    """Plans, one for a person.

    Comparisons cycle: every pair of methods under every question comes equally often, scene
    after scene. Sides are drawn; every second plan mirrors the previous one, in another order.

    Args:
        methods: methods of each item.
        choices: choices of a plan; all comparisons if there are fewer.
        checks: attention checks of a plan, besides the choices.
        seed: seed of all random draws.

    Raises:
        ValueError: no item has two methods.

    Example:
        >>> first, second = draw([["a", "b"]], ["better"], plans=2, choices=1, checks=0, seed=0)
        >>> (first[0].left, first[0].right) == (second[0].right, second[0].left)
        True
    """
    rng = random.Random(seed)
    stream = _comparisons(methods, questions, rng)
    if not stream:
        raise ValueError("methods: got no item with two methods, expected at least one")
    count, taken = min(choices, len(stream)), itertools.cycle(stream)
    result: list[list[Choice]] = []
    while len(result) < plans:
        own = [rng.choice((choice, choice.mirrored())) for choice in itertools.islice(taken, count)]
        tests = _checks(methods, questions, checks, rng)
        for half in (own, [choice.mirrored() for choice in own]):
            result.append(_ordered(half, tests, questions, rng))
            tests = [choice.mirrored() for choice in tests]
    return result[:plans]


def _comparisons(
    methods: Sequence[Sequence[str]], questions: Sequence[str], rng: random.Random
) -> list[Choice]:
    """All comparisons, each kind (pair and question) once before any comes again."""
    kinds: dict[tuple[str, str, str], list[int]] = {}
    items = list(range(len(methods)))
    rng.shuffle(items)
    for item in items:
        for a, b in itertools.combinations(sorted(methods[item]), 2):
            for question in questions:
                kinds.setdefault((question, a, b), []).append(item)
    # Kinds begin at different items, so that a part of the stream has all items.
    turned = [
        [(kind, own[(k + r) % len(own)]) for r in range(len(own))]
        for k, (kind, own) in enumerate(kinds.items())
    ]
    stream = []
    for rank in range(max(map(len, turned), default=0)):
        block = [own[rank] for own in turned if rank < len(own)]
        rng.shuffle(block)
        stream += [Choice(item, question, a, b) for (question, a, b), item in block]
    return stream


def _checks(
    methods: Sequence[Sequence[str]], questions: Sequence[str], count: int, rng: random.Random
) -> list[Choice]:
    """Attention checks with the scrambled side on the left and on the right in turn."""
    first, result = rng.randrange(2), []
    for number in range(count):
        item = rng.randrange(len(methods))
        choice = Choice(item, rng.choice(questions), rng.choice(sorted(methods[item])), SCRAMBLED)
        result.append(choice if (number + first) % 2 else choice.mirrored())
    return result


def _ordered(
    choices: list[Choice], checks: list[Choice], questions: Sequence[str], rng: random.Random
) -> list[Choice]:
    """Question by question in a drawn order, with the checks spread among the choices."""
    order = list(questions)
    rng.shuffle(order)
    mixed = rng.sample(choices, len(choices))
    mixed.sort(key=lambda choice: order.index(choice.question))
    for number, check in enumerate(checks, start=1):
        place = number * len(mixed) // (len(checks) + 1)
        # A check asks its neighbours' question.
        asked = mixed[min(place, len(mixed) - 1)].question
        mixed.insert(place, replace(check, question=asked))
    return mixed
