"""Mesh files: our reader against trimesh's and, for files made here, against closed forms."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from attnwarp_eval.scene.meshes import MESH_SUFFIXES, MeshFile, read_mesh_file
from scripts.survey import writers
from scripts.survey.outcome import Outcome, Row, attempt, refusal
from scripts.survey.polygons import PLANAR, read_polygons
from scripts.survey.solids import Solid, solids

PART = "meshes"

WRITTEN_HERE = ("made", "trimesh", "VTK")
"""Beginnings of the names of files that :func:`made` and :func:`by_libraries` write."""

TOLERANCE = 1e-6
"""Relative difference at which two readings differ: one rounding of float32 is 6e-8, and a sum over
triangles of such vertices keeps it; one triangle of a million moves the sum by as much."""

SIX_DIGITS = 1e-5
"""VTK writes text with six digits."""


@dataclass(frozen=True)
class Facts:
    """Facts that two readers must agree on."""

    triangles: int | None
    area: float
    volume: float
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True)
class Case:
    """A file; what it must hold, where that is known, and to which relative tolerance."""

    name: str
    path: Path
    truth: Facts | None = None
    tolerance: float = TOLERANCE


def measure(vertices: npt.NDArray[np.float64], faces: npt.NDArray[np.int64]) -> Facts:
    """Facts of (V, 3) vertices and (F, 3) triangles; the volume is about the origin."""
    points = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]
    twice = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return Facts(
        len(points),
        float(np.linalg.norm(twice, axis=1).sum()) / 2,
        float(np.einsum("ij,ij->", points[:, 0], twice)) / 6,
        tuple(points.min((0, 1)).tolist()),
        tuple(points.max((0, 1)).tolist()),
    )


def difference(ours: Facts, theirs: Facts, tolerance: float) -> str:
    """Facts that differ, with both values; empty if none."""
    span = max(map(abs, (*theirs.low, *theirs.high))) or 1.0
    scales = {
        "area": abs(theirs.area),
        # A closed surface far from the origin encloses the difference of large numbers.
        "volume": abs(theirs.area) * span,
    }
    parts = []
    if theirs.triangles is not None and ours.triangles != theirs.triangles:
        parts.append(f"{ours.triangles} triangles against {theirs.triangles}")
    for name, scale in scales.items():
        one, two = getattr(ours, name), getattr(theirs, name)
        if not abs(one - two) <= tolerance * scale:
            parts.append(f"{name} {one:.7g} against {two:.7g}")
    gap = np.abs(np.array([ours.low, ours.high]) - np.array([theirs.low, theirs.high])).max()
    if not gap <= tolerance * span:
        parts.append(f"bounds {gap:.3g} apart")
    return ", ".join(parts)


def trimesh_facts(path: Path) -> Facts:
    """The facts of a file as trimesh reads it.

    Raises:
        ValueError: trimesh makes no triangles of it.
    """
    import trimesh

    mesh = trimesh.load(path, process=False, force="mesh")
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise ValueError("no triangles")
    return measure(mesh.vertices, mesh.faces)


def polygon_facts(path: Path, whole: Facts, theirs: Facts | None) -> Facts | None:
    """The facts of an .obj or .off file by its polygons, or None where they decide nothing.

    A polygon that is not planar has no area of its own. For such files these are ``whole``, the
    facts of our reading, if its area lies between the least possible and that of trimesh's fans.
    """
    try:
        polygons = read_polygons(path)
        triangles, area, volume, height = polygons.sums()
    except (ValueError, IndexError):
        return None  # no whole file: the second reader decides
    corners = polygons.vertices[[k for face in polygons.faces for k in face]]
    truth = Facts(
        triangles, area, volume, tuple(corners.min(0).tolist()), tuple(corners.max(0).tolist())
    )
    if height <= PLANAR:
        return truth
    if theirs is None or not area <= whole.area * (1 + TOLERANCE) <= theirs.area * (
        1 + 2 * TOLERANCE
    ):
        return None
    return replace(truth, area=whole.area, volume=whole.volume)


def compare(case: Case) -> Row:
    """The row of one file.

    What the file must hold decides; where that is not stated, its polygons; else trimesh.
    """
    ours = attempt(lambda: read_mesh_file(case.path))
    theirs = attempt(lambda: trimesh_facts(case.path))
    if ours.error is not None:
        both = theirs.error is not None
        return refusal(PART, case.name, ours.error, case.path.parent, both=both)
    result = ours.result
    assert isinstance(result, MeshFile)
    facts = measure(result.mesh.vertices, result.mesh.faces)
    whole = replace(facts, triangles=len(result.mesh.faces) + result.flat)
    second = theirs.result if isinstance(theirs.result, Facts) else None
    truth = case.truth or polygon_facts(case.path, whole, second)
    if truth and truth.triangles is None and second:
        truth = replace(truth, triangles=second.triangles)
    expected = truth or second
    if expected and (wrong := difference(facts, expected, case.tolerance)):
        # Triangles without area explain a count, and nothing else. What else a notice says, such
        # as unused textures, excuses no difference.
        explained = result.crossed or not difference(whole, expected, case.tolerance)
        told = explained and any(str(result) in text for text in ours.notices)
        outcome = Outcome.NOTICE if told else Outcome.SILENT
        return Row(PART, case.name, outcome, f"{wrong}; notice: {result}" if told else wrong)
    if second is None:
        outcome = Outcome.SAME if truth else Outcome.ALONE
        return Row(PART, case.name, outcome, f"trimesh refuses it: {theirs.error}")
    apart = difference(whole, second, TOLERANCE)
    return Row(PART, case.name, Outcome.SAME, f"trimesh has {apart}" if apart else "")


def made(folder: Path, seed: int) -> Iterator[Case]:
    """Files written here: every solid in every format, and files with something wrong."""
    shapes = solids(seed)
    for shape in shapes:
        for is_polygons, formats in ((True, writers.POLYGONS), (False, writers.TRIANGLES)):
            for ending, write in formats.items():
                path = folder / f"{shape.name.replace(' ', '-')}-{ending}"
                path.write_bytes(write(shape))
                yield Case(f"made: {path.name}", path, _truth(shape, is_polygons))
    for name, data in _faulty(shapes[0]).items():
        path = folder / f"faulty-{name}"
        path.write_bytes(data)
        yield Case(f"made: {path.name}", path)


def _truth(shape: Solid, is_polygons: bool) -> Facts:
    area, volume = shape.closed_form()
    corners = shape.vertices[[k for face in shape.faces for k in face]]
    count = sum(len(face) - 2 for face in shape.faces) if is_polygons else len(shape.triangles)
    return Facts(count, area, volume, tuple(corners.min(0)), tuple(corners.max(0)))


def _faulty(box: Solid) -> dict[str, bytes]:
    """Files that a program may well write, with a fault or something besides triangles."""
    obj, off = writers.obj(box), writers.off(box)
    ply, stl = writers.ply(box, "ascii"), writers.stl(box, text=False)
    glb = writers.glb(box, "u2")
    little = writers.ply(box, "binary_little_endian")
    lines = obj.decode().splitlines()
    vertices = "\n".join(line for line in lines if line.startswith("v ")).encode() + b"\n"
    return {
        "cut.obj": obj[: len(obj) // 2],
        "cut.off": off[: len(off) // 2],
        "cut.ply": little[:-7],
        "cut.stl": stl[:-20],
        "cut.glb": glb[:-9],
        "longer.ply": little + b"more",
        "longer.stl": stl + b"more",
        "beyond.obj": obj + b"f 1 2 999\n",
        "beyond.off": off.replace(b"4 0 1", b"4 0 99", 1),
        "zero.obj": obj + b"f 0 1 2\n",
        "two-corners.obj": obj + b"f 1 2\n",
        "flat.obj": obj + b"f 1 1 2\nf 3 4 4\n",
        "bow-tie.obj": vertices + b"f 1 2 3 4\nf 1 3 2 4\n",
        "twice.obj": obj + b"f 5 6 7\nf 5 6 7\n",
        "unused.obj": obj + b"v 100 100 100\n",
        "lines.obj": obj + b"l 1 2\np 3\n",
        "cloud.obj": vertices,
        "nan.obj": obj.replace(b"v ", b"v nan ", 1),
        "word.obj": obj.replace(b"v ", b"v one ", 1),
        "far.obj": obj + b"v 1e30 0 0\nf 1 2 11\n",
        "continued.obj": obj + b"f 1 2 \\\n 3\n",
        "colours.obj": b"".join(
            line + (b" 1 0 0\n" if line.startswith(b"v ") else b"\n") for line in obj.splitlines()
        ),
        "windows.obj": obj.replace(b"\n", b"\r\n"),
        "windows.ply": ply.replace(b"\n", b"\r\n"),
        "windows.off": off.replace(b"\n", b"\r\n"),
        "comments.off": off.replace(b"\n", b" # comment\n"),
        "painted.off": b"".join(
            line + (b" 255 0 0\n" if line[:2] in (b"4 ", b"3 ") else b"\n")
            for line in off.splitlines()
        ),
        "header.off": off.replace(b"OFF\n", b"OFF "),
        "bare.off": off.removeprefix(b"OFF\n"),
        "index.ply": ply.replace(b"vertex_indices", b"vertex_index"),
        "double.ply": ply.replace(b"float", b"double"),
        "cloud.ply": ply.replace(b"element face", b"element edge"),
        "capital.stl": writers.stl(box, text=True).upper().replace(b"E-", b"e-"),
        "two.stl": writers.stl(box, text=True) * 2,
        "empty.obj": b"",
        "empty.stl": b"",
        "words.ply": b"this is no mesh\n",
    }


def by_libraries(folder: Path) -> Iterator[Case]:
    """Files that other programs write, of the libraries that are installed."""
    if importlib.util.find_spec("trimesh"):
        import trimesh

        create = trimesh.creation
        bodies = {
            "box": create.box((1, 2, 3)),
            "ball": create.icosphere(2),
            "capsule": create.capsule(1.0, 0.5),
            "cylinder": create.cylinder(1.0, 2.0),
            "ring": create.annulus(0.5, 1.0, 0.5),
            "torus": create.torus(2.0, 0.5),
            "cone": create.cone(1.0, 2.0),
        }
        for name, body in bodies.items():
            for suffix in MESH_SUFFIXES:
                path = folder / f"trimesh-{name}{suffix}"
                body.export(path)
                truth = measure(body.vertices, body.faces)
                yield Case(f"trimesh: {path.name}", path, truth)
    if importlib.util.find_spec("pyvista"):
        import pyvista

        bodies = {
            "cylinder": pyvista.Cylinder(),
            "arrow": pyvista.Arrow(),
            "dodecahedron": pyvista.PlatonicSolid("dodecahedron"),
            "disc": pyvista.Disc(c_res=12),
            "grid": pyvista.Plane(i_resolution=5, j_resolution=4),
            "stripes": pyvista.Sphere().strip(),
            "klein": pyvista.ParametricKlein(),
            "superellipsoid": pyvista.Superquadric(),
        }
        for name, body in bodies.items():
            whole = body.triangulate()
            truth = measure(whole.points, whole.faces.reshape(-1, 4)[:, 1:])
            truth = replace(truth, triangles=None)  # VTK leaves triangles without area in or out
            for suffix in (".ply", ".stl", ".obj"):
                for binary in (True, False) if suffix != ".obj" else (True,):
                    path = folder / f"vtk-{name}-{'binary' if binary else 'text'}{suffix}"
                    body.save(path, binary=binary)
                    yield Case(f"VTK: {path.name}", path, truth, SIX_DIGITS)


def shipped() -> Iterator[Case]:
    """Meshes that installed packages bring along as examples."""
    for package in ("pyvista", "trimesh", "open3d", "skimage"):
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(root).rglob("*")):
                if path.suffix.lower() in MESH_SUFFIXES:
                    yield Case(f"{package} itself: {path.name}", path)


def in_folders(folders: list[Path]) -> Iterator[Case]:
    """Meshes anywhere under the folders that a person names."""
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.suffix.lower() in MESH_SUFFIXES and path.is_file():
                yield Case(f"{folder.name}: {path.relative_to(folder)}", path)
