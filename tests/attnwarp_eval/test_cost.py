"""Oracles: a clock of the test's own, and the calls that were made."""

import itertools

import pytest

from attnwarp_eval import cost


def test_all_contestants_run_in_every_round_and_the_first_one_twice():
    calls = []
    contestants = [lambda turn, k=k: calls.append((k, turn)) or k for k in range(3)]
    announced = []
    turns = cost.in_turn(contestants, 4, before=announced.append)
    assert turns.results == [[0] * 4, [1] * 4, [2] * 4]
    assert [len(seconds) for seconds in [*turns.seconds, turns.again]] == [4] * 4
    # The first round is not kept, and the first contestant's second run draws other noise.
    assert sorted(calls) == sorted(
        [(k, t) for k in range(3) for t in range(5)] + [(0, t + cost.AGAIN) for t in range(5)]
    )
    assert announced == [k for k, _ in calls]
    orders = {tuple(k for k, _ in calls[i : i + 4]) for i in range(0, 20, 4)}
    assert len(orders) > 1


def test_the_order_depends_on_the_seed_alone():
    def order(seed):
        calls = []
        cost.in_turn([lambda _, k=k: calls.append(k) for k in range(5)], 6, seed=seed)
        return calls

    assert order(1) == order(1) != order(2)


def test_seconds_are_those_of_the_contestant_and_not_of_what_comes_before_it(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(cost.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(cost.time, "process_time", lambda: 2 * clock[0])  # two busy threads

    def takes(seconds):
        def work(turn):
            clock[0] += seconds * (turn % cost.AGAIN or 100)  # the first round is slow

        return work

    def wait(_):
        clock[0] += 1000

    turns = cost.in_turn([takes(2), takes(8)], 3, before=wait)
    assert turns.seconds == [[2, 4, 6], [8, 16, 24]] and turns.again == [2, 4, 6]
    assert turns.cpu == [[4, 8, 12], [16, 32, 48]]


def test_a_contestant_that_fails_ends_the_measurement():
    turns = itertools.count()

    def fails(_):
        if next(turns) == 2:
            raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        cost.in_turn([fails], 5)
