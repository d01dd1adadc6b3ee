"""Triangle meshes from files: one reader for each format, and polygons cut into triangles.

The readers are this package's own because damage must not pass: Open3D ends the process on some
damaged .off files and drops the polygons of an .obj, and trimesh takes a face line with fewer
corners than it announces.
"""

from attnwarp_eval.scene.meshes.read import (
    MESH_SUFFIXES,
    READER_PROTOCOL,
    MeshFile,
    read_mesh,
    read_mesh_file,
)

__all__ = ["MESH_SUFFIXES", "READER_PROTOCOL", "MeshFile", "read_mesh", "read_mesh_file"]
