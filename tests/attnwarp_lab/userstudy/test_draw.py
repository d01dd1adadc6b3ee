"""Oracle: what was drawn, counted."""

import itertools
from collections import Counter

import pytest

from attnwarp_lab.userstudy.draw import SCRAMBLED, draw

METHODS = [["a", "b", "c", "d"], ["a", "b", "c", "d"], ["a", "c", "d"]]
QUESTIONS = ["instruction", "quality"]
COMPARISONS = [
    (item, question, pair)
    for item, methods in enumerate(METHODS)
    for question in QUESTIONS
    for pair in itertools.combinations(methods, 2)
]


def drawn(**changes):
    settings = {"plans": 12, "choices": 10, "checks": 3, "seed": 7} | changes
    return draw(METHODS, QUESTIONS, **settings)


def compared(choice):
    return (choice.item, choice.question, tuple(sorted((choice.left, choice.right))))


def own(plan):
    return [choice for choice in plan if not choice.is_check]


def test_every_comparison_comes_equally_often_and_none_twice_to_a_person():
    # 30 comparisons: 6 pairs of mirrored plans of 10 go round twice, each time with both sides.
    count = Counter(compared(choice) for plan in drawn() for choice in own(plan))
    assert count == dict.fromkeys(COMPARISONS, 4)
    for plan in drawn():
        assert len({compared(choice) for choice in own(plan)}) == 10


def test_sides_are_exactly_balanced_over_two_plans():
    for choices in (1, 7, 10, 1000):
        plans = drawn(choices=choices)
        for plan in plans:
            assert len(own(plan)) == min(choices, len(COMPARISONS))
        for first, second in zip(plans[::2], plans[1::2], strict=True):
            pairs = [(*compared(c), c.left, c.right) for c in own(first) + own(second)]
            assert Counter(pairs) == Counter((i, q, p, r, le) for i, q, p, le, r in pairs)


def test_scenes_come_evenly_to_each_person():
    for plan in drawn(choices=12):
        assert min(Counter(choice.item for choice in own(plan)).values()) >= 2


def test_checks_are_spread_on_both_sides_and_ask_what_their_neighbours_ask():
    for plan in drawn(checks=4):
        places = [k for k, choice in enumerate(plan) if choice.is_check]
        assert len(places) == 4 and min(places) > 0
        assert min(b - a for a, b in itertools.pairwise(places)) > 1
        assert Counter(plan[k].left == SCRAMBLED for k in places) == {True: 2, False: 2}
        blocks = [question for question, _ in itertools.groupby(c.question for c in plan)]
        assert len(blocks) == len(set(blocks))


def test_the_seed_decides_everything():
    assert drawn() == drawn() != drawn(seed=8)


def test_one_method_alone_cannot_be_compared():
    with pytest.raises(ValueError, match="no item with two methods"):
        draw([["a"]], QUESTIONS, plans=1, choices=1, checks=0, seed=0)
