"""glTF 2.0 in one binary file (.glb): the triangles of its scene, and its unused contents."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from attnwarp_eval.scene.meshes.surface import Array, Indices, Surface, clip

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

READ = ("KHR_mesh_quantization",)
"""Required extensions that change the geometry and are read."""

LOOKS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_animation_")
"""Name prefixes of extensions that do not affect geometry."""

POSE = frozenset(("matrix", "translation", "rotation", "scale"))

POINTS, LINES, TRIANGLES, STRIP, FAN = 0, (1, 2, 3), 4, 5, 6


class _Part(BaseModel):
    """Part of a glTF file; unlisted fields do not affect the geometry."""

    model_config = ConfigDict(strict=True, extra="ignore", frozen=True)


Index = Annotated[int, Field(ge=0)]
Number = float | int


class _View(_Part):
    buffer: Index
    byteOffset: Index = 0
    byteLength: Index
    byteStride: Index | None = None


class _Accessor(_Part):
    bufferView: Index | None = None
    byteOffset: Index = 0
    componentType: int
    normalized: bool = False
    count: Index
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    sparse: dict[str, Any] | None = None


class _Primitive(_Part):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: int | None = None
    mode: int = Field(4, ge=0, le=6)
    targets: list[Any] = []


class _Mesh(_Part):
    primitives: list[_Primitive]


class _Node(_Part):
    children: tuple[Index, ...] = ()
    mesh: Index | None = None
    skin: int | None = None
    matrix: list[Number] | None = Field(None, min_length=16, max_length=16)
    translation: tuple[Number, Number, Number] = (0, 0, 0)
    rotation: tuple[Number, Number, Number, Number] = (0, 0, 0, 1)
    scale: tuple[Number, Number, Number] = (1, 1, 1)


class _Scene(_Part):
    nodes: list[Index] = []


class _Buffer(_Part):
    uri: str | None = None


class _Document(_Part):
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []
    scene: Index = 0
    scenes: list[_Scene] = []
    nodes: list[_Node] = []
    meshes: list[_Mesh] = []
    accessors: list[_Accessor] = []
    bufferViews: list[_View] = []
    buffers: list[_Buffer] = []
    textures: list[Any] = []
    materials: list[Any] = []
    animations: list[Any] = []


def read_glb(data: bytes) -> Surface:
    """Read the triangles of a .glb file's scene, with the transforms of its nodes (glTF 2.0,
    chapters 3 and 4).

    Raises:
        ValueError: invalid lengths or indices, data outside the file, or a required
            extension that is not supported, which is named.
    """
    head, binary = _chunks(data)
    try:
        return _Reader(_Document.model_validate_json(head), binary).surface()
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the document"
        raise ValueError(f"glTF: {place}: {first['msg']}") from error
    except (LookupError, TypeError) as error:
        raise ValueError(f"glTF: names what it does not hold ({error})") from error


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """The document, and the binary chunk that it refers to."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError("begins with no glTF header")
    version, length, size = struct.unpack("<III", data[4:16])
    if version != 2:
        raise ValueError(f"glTF of version {version}, expected 2")
    if length != len(data):
        raise ValueError(f"announces {length} bytes, but has {len(data)}")
    return data[20 : 20 + size], data[28 + size :]


class _Reader:
    """One document with its binary chunk."""

    def __init__(self, document: _Document, binary: bytes) -> None:
        self.document = document
        self.binary = binary
        self.ignored: Counter[str] = Counter()

    def surface(self) -> Surface:
        self._check_extensions()
        vertices, faces, tints = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], []
        count, seen = 0, {"materials": False, "skins": False, "morph targets": False}
        for node, pose in self._nodes():
            if node.mesh is None:
                continue
            seen["skins"] |= node.skin is not None
            for primitive in self.document.meshes[node.mesh].primitives:
                seen["materials"] |= primitive.material is not None
                seen["morph targets"] |= bool(primitive.targets)
                if (part := self._primitive(primitive, pose)) is None:
                    continue
                points, triangles, tint = part
                vertices.append(points)
                faces.append(triangles + count)
                tints.append(tint)
                count += len(points)
        words = [f"{number} primitives of {kind}" for kind, number in self.ignored.items()]
        for name, number in (
            ("textures", len(self.document.textures)),
            ("animations", len(self.document.animations)),
        ):
            if number:
                words.append(f"{number} {name}")
        words += [name for name, present in seen.items() if present]
        tint = None
        if any(t is not None for t in tints):
            tint = np.concatenate(
                [
                    np.ones_like(p) if t is None else t
                    for p, t in zip(vertices[1:], tints, strict=True)
                ]
            )
        corners = np.concatenate(faces).ravel()
        return Surface(
            np.concatenate(vertices),
            corners,
            np.full(len(corners) // 3, 3, np.int64),
            tint,
            tuple(words),
        )

    def _check_extensions(self) -> None:
        required = set(self.document.extensionsRequired)
        # Copies of a mesh are geometry, even in an optional extension.
        required |= {"EXT_mesh_gpu_instancing"} & set(self.document.extensionsUsed)
        for name in sorted(required):
            if name not in READ and not name.startswith(LOOKS):
                raise ValueError(
                    f"needs the glTF extension {clip(name)}, which is not read; export it without"
                )

    def _nodes(self) -> Iterator[tuple[_Node, Array]]:
        """The nodes of the scene, each with its (4, 4) pose in the world."""
        document = self.document
        if document.scenes:
            roots = self.document.scenes[document.scene].nodes
        else:
            children = {child for node in document.nodes for child in node.children}
            roots = [k for k in range(len(document.nodes)) if k not in children]
        waiting = [(k, np.eye(4)) for k in reversed(roots)]
        visited: set[int] = set()
        while waiting:
            index, above = waiting.pop()
            node = self.document.nodes[index]
            if index in visited:
                raise ValueError(f"glTF: node {index} is reached twice, expected a tree")
            visited.add(index)
            pose = above
            if not node.model_fields_set.isdisjoint(POSE):
                pose = above @ _pose(node)
                if not np.isfinite(pose).all():
                    raise ValueError(f"glTF: the transform of node {index} is not finite")
            yield node, pose
            waiting += [(child, pose) for child in reversed(node.children)]

    def _primitive(
        self, primitive: _Primitive, pose: Array
    ) -> tuple[Array, Indices, Array | None] | None:
        if primitive.mode == POINTS or primitive.mode in LINES:
            self.ignored["points" if primitive.mode == POINTS else "lines"] += 1
            return None
        if "POSITION" not in primitive.attributes:
            self.ignored["no position"] += 1
            return None
        points = self._values(primitive.attributes["POSITION"], "VEC3")
        if primitive.indices is None:
            order = np.arange(len(points), dtype=np.int64)
        else:
            order = self._indices(primitive.indices, len(points))
        triangles = _triangles(order, primitive.mode)
        tint = None
        if "COLOR_0" in primitive.attributes:
            tint = self._values(primitive.attributes["COLOR_0"], "VEC3", "VEC4")[:, :3]
            if len(tint) != len(points):
                raise ValueError("glTF: COLOR_0 is not a colour for each vertex")
            tint = tint.clip(0, 1)  # section 3.7.2.1
        if np.linalg.det(pose[:3, :3]) < 0:
            triangles = triangles[:, ::-1]  # a mirror reverses the winding
        return points @ pose[:3, :3].T + pose[:3, 3], triangles, tint

    def _indices(self, index: int, vertices: int) -> Indices:
        order = self._raw(index, "SCALAR")
        if len(order) and order.max() >= vertices:
            raise ValueError(f"a face names vertex {int(order.max())}, but its part has {vertices}")
        return order[:, 0].astype(np.int64)

    def _values(self, index: int, *kinds: str) -> Array:
        raw = self._raw(index, *kinds)
        values = raw.astype(np.float64)
        if not np.isfinite(values).all():
            raise ValueError(f"glTF: accessor {index} holds numbers that are not finite")
        if self.document.accessors[index].normalized and raw.dtype.kind in "iu":
            # Section 3.11: the least signed number means -1 as its neighbour does.
            values = np.maximum(values / np.iinfo(raw.dtype).max, -1.0)
        return values

    def _raw(self, index: int, *kinds: str) -> npt.NDArray[Any]:
        accessor = self.document.accessors[index]
        if accessor.type not in kinds:
            raise ValueError(
                f"glTF: accessor {index} is {accessor.type}, expected {' or '.join(kinds)}"
            )
        if accessor.sparse is not None:
            raise ValueError(f"glTF: accessor {index} is sparse, which is not read")
        kind, width = np.dtype(COMPONENTS[accessor.componentType]), WIDTHS[accessor.type]
        if accessor.bufferView is None:
            raise ValueError(
                f"glTF: accessor {index} has no data"
                " (compressed by an extension that is not read?); export it without"
            )
        view = self.document.bufferViews[accessor.bufferView]
        buffer = self.document.buffers[view.buffer]
        if view.buffer or buffer.uri is not None:
            raise ValueError("glTF: keeps data outside its binary chunk; export it as one .glb")
        stride = view.byteStride or kind.itemsize * width
        return np.ndarray(
            (accessor.count, width),
            kind,
            self.binary,
            view.byteOffset + accessor.byteOffset,
            (stride, kind.itemsize),
        )


def _pose(node: _Node) -> Array:
    if node.matrix is not None:
        return np.array(node.matrix, float).reshape(4, 4).T
    x, y, z, w = node.rotation
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.99 < norm < 1.01:
        raise ValueError(f"glTF: a node's rotation has length {norm:.3g}, expected 1")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.array(node.scale)
    pose[:3, 3] = node.translation
    return pose


def _triangles(order: Indices, mode: int) -> Indices:
    if mode == TRIANGLES:
        if len(order) % 3:
            raise ValueError(f"glTF: {len(order)} corners do not make whole triangles")
        return order.reshape(-1, 3)
    if len(order) < 3:
        raise ValueError(f"glTF: {len(order)} corners make no strip or fan")
    if mode == STRIP:
        out = np.stack([order[:-2], order[1:-1], order[2:]], axis=-1)
        out[1::2] = out[1::2][:, [1, 0, 2]]  # every second triangle turns the other way
        return out
    return np.stack([order[1:-1], order[2:], np.full(len(order) - 2, order[0])], axis=-1)
