"""Scenes: the format of a scene file, and its geometry, materials, lights, cameras and edits. See
docs/truth/scenes.md.
"""
