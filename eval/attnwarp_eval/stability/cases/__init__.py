"""The hard cases, by room of the library."""

from dataclasses import replace

from attnwarp_eval.stability.case import Case
from attnwarp_eval.stability.cases import editing, gradients, lifting, metrics, splats, truth, warps

EVERY: list[Case] = [
    replace(case, group=room.__name__.rpartition(".")[2])
    for room in (splats, warps, lifting, truth, metrics, editing, gradients)
    for case in room.CASES
]
"""Grouped by their modules."""
