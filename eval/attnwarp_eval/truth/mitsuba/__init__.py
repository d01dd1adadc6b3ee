"""Pictures of a scene by Mitsuba 3."""

from attnwarp_eval.truth.mitsuba.build import forget, use
from attnwarp_eval.truth.mitsuba.graph import graph
from attnwarp_eval.truth.mitsuba.render import (
    APPEARANCE_PROTOCOL,
    comparable,
    position_and_shape,
    render_plan,
)

__all__ = [
    "APPEARANCE_PROTOCOL",
    "comparable",
    "forget",
    "graph",
    "position_and_shape",
    "render_plan",
    "use",
]
