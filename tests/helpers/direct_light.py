"""Scenes of the package with direct light alone, for tests whose closed form is that of it."""

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import Scene


def direct(name):
    """The scene ``name`` with ``bounces: 1`` in place of its own number."""
    scene = load_scene(name)
    appearance = scene.spec.appearance.model_copy(update={"bounces": 1})
    return Scene(scene.spec.model_copy(update={"appearance": appearance}), scene.path)
