"""Triangle meshes from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from attnwarp_eval.scene.shapes import Mesh

# No .gltf: it keeps its vertices in another file, which a hash of its own bytes would not see.
MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl", ".off")


def read_mesh(path: Path) -> Mesh:
    """A triangle mesh from a file (.ply, .obj, .glb, .stl, .off), all its parts joined.

    Vertex colours, where the file has them, become the tint (taken as sRGB). Degenerate triangles
    are dropped with a :class:`MeshNotice`.

    Raises:
        ValueError: the format is not known, or the file holds no triangles.
    """
    from attnwarp_eval._open3d import open3d

    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ValueError(
            f"{path}: mesh format {path.suffix!r} is not read; use one of"
            f" {', '.join(MESH_SUFFIXES)}"
        )
    o3d = open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        # Post-processing off: it would merge vertices and reorder faces behind the user's back.
        mesh = o3d.io.read_triangle_mesh(str(path), enable_post_processing=False)
    vertices = np.asarray(mesh.vertices, dtype=np.float64).copy()
    faces = np.asarray(mesh.triangles, dtype=np.int64).reshape(-1, 3).copy()
    if not len(faces):
        raise ValueError(
            f"{path}: holds no triangles (a point cloud, or a damaged file?); export it as a mesh"
        )
    tint = None
    if mesh.has_vertex_colors():
        from attnwarp_eval.colors import to_linear

        tint = to_linear(np.asarray(mesh.vertex_colors, dtype=np.float64))
    return Mesh(vertices, faces, None, tint).cleaned(path.name)
