"""Depth and normals of sampled splats against exact truth."""
