"""Scenes: what a file of scenes/ says, and the geometry, materials, lights, cameras and edits that
follow.
"""
