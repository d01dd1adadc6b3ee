"""What is exactly known about a scene: geometry by ray casting and closed forms, appearance by Mitsuba."""

from __future__ import annotations

from attnwarp_eval.colors import to_srgb
from attnwarp_eval.truth.mitsuba import appearance, render_plan
from attnwarp_eval.truth.pairs import AMBIGUOUS, HIDDEN, NONE, VISIBLE, TwoView, edge_band, two_view
from attnwarp_eval.truth.raycast import Geometry, Hits, RayHits

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
