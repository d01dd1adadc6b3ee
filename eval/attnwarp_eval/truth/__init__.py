"""Exact knowledge of a scene: geometry by ray casting and closed forms, appearance by Mitsuba."""

from __future__ import annotations

from attnwarp_eval.colors import to_srgb
from attnwarp_eval.truth.correspondence import edge_band, two_view
from attnwarp_eval.truth.mitsuba import render_plan
from attnwarp_eval.truth.pictures import appearance
from attnwarp_eval.truth.raycast import Geometry, RayHits
from attnwarp_eval.two_view import AMBIGUOUS, HIDDEN, NONE, VISIBLE, Hits, TwoView

__all__ = [
    "AMBIGUOUS",
    "HIDDEN",
    "NONE",
    "VISIBLE",
    "Geometry",
    "Hits",
    "RayHits",
    "TwoView",
    "appearance",
    "edge_band",
    "render_plan",
    "to_srgb",
    "two_view",
]
