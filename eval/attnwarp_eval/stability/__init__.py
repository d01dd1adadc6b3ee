"""Numerically hard cases, each swept over its hardness until the computation breaks.

A case has an input, an oracle that shares no code with the code under test, a tolerance with its
reason, and the level up to which it must hold. The study's probe, the command and the tests all
call the same cases.
"""

from __future__ import annotations

import importlib
from functools import cache

from attnwarp.errors import InputError, suggest
from attnwarp_eval.plugins import load_plugins
from attnwarp_eval.stability.case import DECADES, Bound, Case, Outcome, Verdict, Way, level_name

__all__ = [
    "DECADES",
    "ROOMS",
    "Bound",
    "Case",
    "Outcome",
    "Verdict",
    "Way",
    "hard_case",
    "hard_cases",
    "level_name",
]


ROOMS = [
    f"attnwarp_eval.stability.cases.{room}"
    for room in ("splats", "warps", "lifting", "truth", "metrics", "editing", "gradients", "fits")
]
"""Modules with ``CASES``, by package of the library. Plugins append theirs."""


@cache
def hard_cases() -> dict[str, Case]:
    """Every case by its name, in the order of their numbers.

    Example:
        >>> from attnwarp_eval.stability import hard_cases
        >>> hard_cases()["zero_baseline"].number
        6
    """
    load_plugins()
    cases: list[Case] = [case for room in ROOMS for case in importlib.import_module(room).CASES]
    table = {item.name: item for item in sorted(cases, key=lambda item: item.number)}
    if len(table) != len(cases):
        raise ValueError("two hard cases have the same name")
    return table


def hard_case(name: str) -> Case:
    """Look up a case by name.

    Raises:
        InputError: no such case.

    Example:
        >>> from attnwarp_eval.stability import Way, hard_case
        >>> hard = hard_case("focal_length")
        >>> hard.outcome(1e5, Way("cpu", "float64")).verdict
        'holds'
    """
    table = hard_cases()
    if name not in table:
        hint = suggest(name, list(table)) or "; `attnwarp-eval stability --list` names them all"
        raise InputError(f"case: no hard case {name!r}{hint}")
    return table[name]
