"""An edit of one view, carried through a scene: Algorithm 1. See docs/editing-a-scene.md."""

from attnwarp.propagate.progress import Step
from attnwarp.propagate.run import Propagation, propagate
from attnwarp.propagate.settings import PRESETS, PropagateSettings, preset
from attnwarp.propagate.stages import Plan

__all__ = [
    "PRESETS",
    "Plan",
    "PropagateSettings",
    "Propagation",
    "Step",
    "preset",
    "propagate",
]
