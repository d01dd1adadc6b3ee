"""Renderer of Gaussian splats with several backends; see docs/method/rendering.md."""

from attnwarp.render.api import Render, normal_from_depth, render

__all__ = ["Render", "normal_from_depth", "render"]
