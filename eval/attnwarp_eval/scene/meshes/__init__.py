"""Triangle meshes from files: one reader for each format, and polygons cut into triangles.

The package has its own readers so that damaged files are refused: trimesh accepts a face line with
fewer corners than it announces.
"""

from attnwarp_eval.scene.meshes.read import (
    MESH_SUFFIXES,
    READER_PROTOCOL,
    MeshFile,
    read_mesh,
    read_mesh_file,
)

__all__ = ["MESH_SUFFIXES", "READER_PROTOCOL", "MeshFile", "read_mesh", "read_mesh_file"]
