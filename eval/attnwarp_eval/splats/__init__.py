"""Gaussians of a scene: sampled on its true surface, or fitted to its true pictures."""
