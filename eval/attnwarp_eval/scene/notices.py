"""Notices on the meshes in a scene, to be read before its figures."""

from __future__ import annotations

import warnings

import numpy as np

from attnwarp_eval.scene.base import SceneNotice
from attnwarp_eval.scene.extent import warn_of_strays
from attnwarp_eval.scene.materials import TEXTURED
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.shapes import Mesh, MeshNotice
from attnwarp_eval.scene.spec import MeshSpec, ObjectSpec
from attnwarp_eval.scene.textures import albedo

LOST = 0.02
"""Albedo by which the texture between the vertices of a mesh may differ from that at its vertices,
on average, without a warning."""


def notices(scene: Scene) -> list[str]:
    """One line for each dropped part of a scene's mesh files, or fault that spoils its pictures.

    Building the scene later gives the same warnings. A scene without mesh files has none.

    Raises:
        SceneError: the scene cannot be built.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> notices(load_scene("spheres"))
        []
    """
    objects = scene.spec.objects
    if not any(isinstance(item.shape, MeshSpec) for item in objects):
        return []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # Built again: cached shapes give no notice.
        shapes = Scene(scene.spec, scene.path).shapes()
        warn_of_strays(scene, shapes)
        for shape in shapes:
            item = objects[shape.object_id]
            if isinstance(shape, Mesh) and isinstance(item.shape, MeshSpec):
                warn_of_lost_texture(item, shape)
    texts = []
    for each in caught:
        if issubclass(each.category, SceneNotice):
            texts.append(str(each.message))
        else:
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return list(dict.fromkeys(texts))


def warn_of_lost_texture(item: ObjectSpec, mesh: Mesh) -> None:
    """Warn of triangles too large for a texture baked into vertices."""
    if not isinstance(item.material, TEXTURED) or item.emission:
        return
    corners = mesh.vertices[mesh.faces]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    dice, area = np.random.default_rng(0), np.cumsum(np.linalg.norm(sides, axis=1))
    drawn = np.searchsorted(area, dice.random(2000) * area[-1])
    shares, corners = dice.dirichlet((1, 1, 1), len(drawn)), corners[drawn]
    baked = albedo(item.texture, corners.reshape(-1, 3)).reshape(corners.shape)
    true = albedo(item.texture, np.einsum("ij,ijk->ik", shares, corners))
    mean = float(np.abs(np.einsum("ij,ijk->ik", shares, baked) - true).mean())
    if mean > LOST:
        warnings.warn(
            f"object {item.name!r}: its pictures miss the texture by an albedo of {mean:.2g} on"
            f" average, since meshes have it at their vertices alone ({len(mesh.faces)} triangles);"
            " give the mesh a shorter longest_edge, or make the texture coarser",
            MeshNotice,
            stacklevel=2,
        )
