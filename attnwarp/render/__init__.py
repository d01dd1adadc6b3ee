"""Gaussian splats to pictures: one door, several backends. See docs/method/rendering.md."""

from attnwarp.render.api import Render, normal_from_depth, render

__all__ = ["Render", "normal_from_depth", "render"]
