"""Pictures of a scene by Mitsuba 3."""

from attnwarp_eval.truth.mitsuba.appearance import (
    APPEARANCE_PROTOCOL,
    appearance,
    comparable,
    position_and_shape,
    render_plan,
)
from attnwarp_eval.truth.mitsuba.build import forget, use
from attnwarp_eval.truth.mitsuba.graph import graph

__all__ = [
    "APPEARANCE_PROTOCOL",
    "appearance",
    "comparable",
    "forget",
    "graph",
    "position_and_shape",
    "render_plan",
    "use",
]
