"""The hard cases, by room of the library."""

from attnwarp_eval.stability.case import Case
from attnwarp_eval.stability.cases import editing, metrics, splats, truth, warps

EVERY: list[Case] = [
    *splats.CASES,
    *warps.CASES,
    *truth.CASES,
    *metrics.CASES,
    *editing.CASES,
]
