"""Export of the view to share: .glb for viewers, .html as a page."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from attnwarp.errors import InputError, optional_imports
from attnwarp.io.file import write_atomically
from attnwarp.io.images import encode_png
from attnwarp_eval.colors import to_linear
from attnwarp_eval.inspect import scene
from attnwarp_eval.inspect.pair import Legend, Pair
from attnwarp_eval.inspect.scene import Part, State
from attnwarp_eval.inspect.subject import Subject

if TYPE_CHECKING:
    import pyvista

ENDINGS = (".html", ".glb")

FLOAT, UINT32, UINT16 = 5126, 5125, 5123
"""glTF's numbers of the types."""

POINTS, LINES, TRIANGLES = 0, 1, 4
"""glTF's numbers of primitive types."""


def check_ending(path: Path) -> None:
    """Refuse a file of an unknown kind, before any computation.

    Raises:
        InputError: another ending.
    """
    if path.suffix not in ENDINGS:
        raise InputError(f"{path}: got {path.suffix or 'no ending'}, expected .html or .glb")


def write_export(path: Path, subject: Subject, state: State, picked: Any = None) -> None:
    """Write the scene of a state; only .html needs OpenGL.

    Args:
        path: ends in .html (a page that needs no network), or .glb (coloured surface, frusta with
            their pictures, splats, rays).
        picked: the report of a picked pixel or cell, or None.

    Raises:
        InputError: another ending.
        MissingExtraError: .html without the extra "web".
    """
    check_ending(path)
    pair = subject.pair(state.variant, state.target)
    parts = scene.parts(subject, pair, state, picked)
    if path.suffix == ".glb":
        data = glb(parts, subject.center, subject.up)
    else:
        title = scene.title(subject, pair, state)
        data = page(parts, subject, pair, title, pair.legend(state.coloring))
    write_atomically(path, lambda stream: stream.write(data))


# --- glTF 2.0, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html


@dataclass
class _Gltf:
    """The parts of a glTF file, with all numbers in one buffer."""

    buffer: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)
    materials: list[dict[str, Any]] = field(default_factory=list)
    images: list[dict[str, Any]] = field(default_factory=list)

    def view(self, data: bytes) -> int:
        self.buffer += bytes(-len(self.buffer) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(data)})
        self.buffer += data
        return len(self.views) - 1

    def accessor(self, values: npt.NDArray[Any], kind: int, **more: Any) -> int:
        width = 1 if values.ndim == 1 else values.shape[1]
        self.accessors.append(
            {
                "bufferView": self.view(np.ascontiguousarray(values).tobytes()),
                "componentType": kind,
                "count": len(values),
                "type": "SCALAR" if width == 1 else f"VEC{width}",
                **more,
            }
        )
        return len(self.accessors) - 1

    def material(self, part: Part) -> int:
        base: dict[str, Any] = {"metallicFactor": 0.0}
        color = [1.0, 1.0, 1.0]
        if part.color is not None:
            digits = part.color.lstrip("#")
            srgb = np.array([int(digits[k : k + 2], 16) for k in (0, 2, 4)]) / 255
            color = to_linear(srgb).tolist()
        base["baseColorFactor"] = [*color, part.opacity]
        if part.picture is not None:
            png = encode_png(np.ascontiguousarray(scene.as_bytes(part.picture())))
            self.images.append({"bufferView": self.view(png), "mimeType": "image/png"})
            base["baseColorTexture"] = {"index": len(self.images) - 1}
        self.materials.append(
            {
                "name": part.name,
                "pbrMetallicRoughness": base,
                "doubleSided": True,
                "alphaMode": "BLEND" if part.opacity < 1 else "OPAQUE",
                "extensions": {"KHR_materials_unlit": {}},
            }
        )
        return len(self.materials) - 1

    def add(self, part: Part, center: npt.NDArray[np.float64]) -> None:
        mesh = part.mesh()
        points = (np.asarray(mesh.points, dtype=np.float64) - center).astype(np.float32)
        if not len(points):
            return
        low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        attributes = {"POSITION": self.accessor(points, FLOAT, min=low, max=high)}
        if part.picture is not None:
            # glTF counts a texture's rows from above, VTK from below.
            uv = np.asarray(mesh.active_texture_coordinates) * [1, -1] + [0, 1]
            attributes["TEXCOORD_0"] = self.accessor(uv.astype(np.float32), FLOAT)
        elif part.color is None:
            linear = to_linear(_point_colors(mesh) / 255)
            colors = np.rint(65535 * np.insert(linear, 3, 1.0, axis=1)).astype(np.uint16)
            attributes["COLOR_0"] = self.accessor(colors, UINT16, normalized=True)
        index, mode = _indices(mesh)
        primitive = {
            "attributes": attributes,
            "indices": self.accessor(index.astype(np.uint32), UINT32),
            "mode": mode,
            "material": self.material(part),
        }
        self.meshes.append({"name": part.name, "primitives": [primitive]})


def glb(
    parts: Sequence[Part], center: npt.NDArray[np.float64], up: npt.NDArray[np.float64]
) -> bytes:
    """A binary glTF file of the parts, upright, with ``center`` at its origin.

    Args:
        center: (3,) subtracted in float64, so that far-away worlds keep precision.
        up: (3,) unit vector, which becomes glTF's +y.
    """
    gltf = _Gltf()
    for part in parts:
        gltf.add(part, center)
    count = len(gltf.meshes)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "attnwarp-eval inspect"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [count]}],
        "nodes": [
            *({"mesh": number, "name": mesh["name"]} for number, mesh in enumerate(gltf.meshes)),
            {"children": list(range(count)), "matrix": _upright(up)},
        ],
        "meshes": gltf.meshes,
        "materials": gltf.materials,
        "textures": [{"source": number} for number in range(len(gltf.images))],
        "images": gltf.images,
        "accessors": gltf.accessors,
        "bufferViews": gltf.views,
        "buffers": [{"byteLength": len(gltf.buffer)}],
    }
    document = {name: value for name, value in document.items() if value != []}
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary = bytes(gltf.buffer) + bytes(-len(gltf.buffer) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        (
            struct.pack("<4sII", b"glTF", 2, length),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        )
    )


def _upright(up: npt.NDArray[np.float64]) -> list[float]:
    """A rotation that turns ``up`` to +y, as the columns of a 4 x 4 matrix."""
    other = np.eye(3)[np.argmin(np.abs(up))]
    x = np.cross(up, other)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = [x, up, np.cross(x, up)]
    return [float(value) for value in matrix.T.ravel()]


def _point_colors(mesh: pyvista.PolyData) -> npt.NDArray[Any]:
    """(N, 3) uint8; a cell's colour goes to its points, which no other cell has."""
    if "colors" in mesh.point_data:
        return np.asarray(mesh.point_data["colors"])
    colors = np.asarray(mesh.cell_data["colors"])
    return np.repeat(colors, mesh.n_points // len(colors), axis=0)


def _indices(mesh: pyvista.PolyData) -> tuple[npt.NDArray[Any], int]:
    if mesh.GetNumberOfPolys():
        return mesh.triangulate().regular_faces.ravel(), TRIANGLES
    if mesh.GetNumberOfLines():
        return mesh.lines.reshape(-1, 3)[:, 1:].ravel(), LINES
    return np.arange(mesh.n_points), POINTS


# --- a page


VIEWER_TITLE = re.compile("<title>.*?</title>", re.DOTALL)

CAPTION = (
    "position: fixed; z-index: 1; left: 0; bottom: 0; margin: 0; padding: .4em .7em;"
    " font: 14px/1.5 system-ui, sans-serif; color: #000; background: #fffc; pointer-events: none"
)


def page(parts: Sequence[Part], subject: Subject, pair: Pair, title: str, legend: Legend) -> bytes:
    """An HTML page with the parts and a viewer in it, which works without a network.

    Args:
        subject, pair: subject and pair with the cameras in view.
        title: title of the page and of the view.
        legend: (text, "#rrggbb") of the colours' meanings.
    """
    with optional_imports():
        from trame_vtk.modules.vtk import serializers
        from trame_vtk.tools.vtksz2html import HTML_VIEWER_PATH
    import io
    import zipfile

    import pyvista

    from attnwarp_eval.inspect.draw import add_part, outside
    from attnwarp_eval.inspect.gl import require_gl

    require_gl(display=False)
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[64, 64])
    plotter.set_background("white")
    for part in parts:
        add_part(plotter, part)
    plotter.camera_position = outside(subject, pair.cameras)
    plotter.render()
    window, context = plotter.render_window, serializers.SynchronizationContext()
    serializers.initialize_serializers()
    context.set_ignore_last_dependencies(True)
    reference = serializers.reference_id
    description = serializers.serialize(None, window, reference(window), context, 1)
    description["extra"] = {
        "vtkRefId": reference(window),
        "centerOfRotation": plotter.camera.GetFocalPoint(),
        "camera": reference(plotter.camera),
    }
    arrays = {
        entry["hash"]: {**entry, "content": context.get_cached_data_array(entry["hash"], False)}
        for entry in serializers.extract_array_hash(description)
    }
    plotter.close()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as stream:
        stream.writestr("index.json", json.dumps({"hashes": arrays, "scene": description}))
    viewer = Path(HTML_VIEWER_PATH).read_text(encoding="utf-8")
    text = base64.b64encode(archive.getvalue()).decode()
    script = (
        "<script>function loadDataSet() { const container = document.querySelector('.content')"
        f" || document.body; OfflineLocalView.load(container, {{base64Str: '{text}'}}); }}</script>"
    )
    head = f"<title>{escape(title)}</title>"
    viewer = VIEWER_TITLE.sub(lambda _: head, viewer, count=1)
    entries = "".join(
        f'<br><span style="color: {color}">\u25a0</span> {escape(name)}' for name, color in legend
    )
    # The viewer clears its container, so the caption is outside.
    body = f'<div class="content"></div><p style="{CAPTION}">{escape(title)}{entries}</p>{script}'
    return viewer.replace("</body>", f"{body}</body>").encode()
