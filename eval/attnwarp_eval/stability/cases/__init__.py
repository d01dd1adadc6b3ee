"""The hard cases, by room of the library."""

from attnwarp_eval.stability.case import Case
from attnwarp_eval.stability.cases import splats, warps

EVERY: list[Case] = [*splats.CASES, *warps.CASES]
