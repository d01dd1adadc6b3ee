"""Scenes of a bench as files: captures for any method, with their truth beside them."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from string import Template
from typing import Annotated, Any, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from attnwarp.errors import InputError
from attnwarp.io import Dataset, write_ply, write_transforms
from attnwarp.io.file import inside
from attnwarp.io.lock import alone_in
from attnwarp.reporting import SILENT, Part, Reporter
from attnwarp_eval.canonical_json import read_as
from attnwarp_eval.drawn.draft import GENERATOR
from attnwarp_eval.drawn.files import to_text
from attnwarp_eval.drawn.scenes import draw
from attnwarp_eval.files import write_atomic, write_picture
from attnwarp_eval.splats.export import first_points
from attnwarp_eval.study.shared.edit_truth import EditTruth, edit_truth
from attnwarp_eval.world import World, splats, world

FORMAT: Final = 2
FILE = "bench.json"
EDITS_FILE = "edits.json"

EDITS = ("colour", "some_colour")
"""Edits of each scene: one right answer, and several."""

YAWS = (10, 30, 45, 60, 90, 120, 150, 180, -150, -120, -90, -60, -45, -30, -10)
"""Degrees from the source to each target, both ways around."""

POINTS = 5000
SPLATS = {"kind": "2d", "count": 16_000, "position_noise": 0.1, "normal_noise": 3.0}
"""Splats sampled on the surfaces, as in the studies."""

LISTING = "truth/files.json"

STRICT = ConfigDict(extra="forbid")
AGAIN = "export or copy the bench again"

Name = Annotated[str, Field(pattern=r"^[\w-][\w .-]*$")]
"""Name of a file or folder in a bench from elsewhere: one that does not lead out of its folder."""


@dataclass(frozen=True, config=STRICT)
class Edit:
    """An edit in a scene's ``edits.json``.

    Attributes:
        name: its name.
        instruction: the change, in words.
        source: the scene before, in words.
        target: the scene after, in words.
        answers: number of right answers.
    """

    name: Name
    instruction: str
    source: str
    target: str
    answers: int


@dataclass(frozen=True, config=STRICT)
class Edits:
    """A scene's ``edits.json``: the names of its views, the source first, and its edits."""

    views: tuple[Name, ...]
    source: Name
    edits: tuple[Edit, ...]


@dataclass(frozen=True, config=STRICT)
class Suite:
    """Definition of a bench, as in its ``bench.json``.

    Attributes:
        format: version of the layout.
        seed: seed of the drawn scenes.
        size: edge of the pictures, px.
        spp: samples per pixel.
        scenes: names of the scenes.
        views: names of the views, the source first.
        files: SHA-256 of every file by its path.
    """

    format: Literal[2]
    seed: int
    size: Annotated[int, Field(ge=16, le=1024)]
    spp: Annotated[int, Field(ge=1)]
    scenes: Annotated[tuple[Name, ...], Field(min_length=1)]
    views: Annotated[tuple[Name, ...], Field(min_length=2)]
    files: Mapping[str, str]

    @classmethod
    def read(cls, folder: Path) -> Suite:
        """Read and check a bench.

        Raises:
            InputError: no bench, of another version, or a file of it is missing or changed.
        """
        path = folder / FILE
        if not path.is_file():
            raise InputError(f"{folder}: is no bench, which has a {FILE}; export one first")
        suite = read_as(cls, path, AGAIN)
        if changed := _changed(folder, suite.files):
            raise InputError(f"{changed}: is missing or changed; {AGAIN}")
        return suite

    def edits(self, folder: Path, scene: str) -> tuple[Edit, ...]:
        """Read a scene's edits.

        Raises:
            InputError: the file is damaged, or names other views than the bench.
        """
        path = folder / scene / EDITS_FILE
        of_scene = read_as(Edits, path, AGAIN)
        if of_scene.views != self.views:
            raise InputError(f"{path}: has other views than {folder / FILE}; {AGAIN}")
        return of_scene.edits

    def identity(self) -> dict[str, Any]:
        """Entries that decide the scenes; results with equal ones can be compared."""
        return {
            "generator": GENERATOR, "seed": self.seed, "size": self.size, "spp": self.spp,
            "views": list(self.views),
        }  # fmt: skip

    def truth(self, folder: Path, scene: str, edit: str) -> tuple[World, EditTruth]:
        """Render the truth of an edit from the scene's file."""
        path = str(truth_file(folder, scene))
        return world(path, self.size), edit_truth(path, self.size, self.spp, edit, self.views)


@dataclass(frozen=True, config=STRICT)
class _Listing:
    """Settings of a finished scene, and SHA-256 of its files by path."""

    asked: dict[str, int]
    files: dict[str, str]


def export(
    folder: Path,
    *,
    count: int = 12,
    seed: int = 0,
    size: int = 256,
    spp: int = 16,
    targets: int = len(YAWS),
    report: Reporter = SILENT,
) -> Suite:
    """Write a bench of drawn scenes; a folder begun earlier is continued.

    A scene with a file that is lost or changed is written again.

    Args:
        folder: output folder.
        count: number of scenes.
        seed: seed of the drawn scenes.
        size: edge of the pictures, px.
        spp: samples per pixel.
        targets: number of views besides the source.
        report: receiver of progress.

    Raises:
        InputError: the folder has another bench, or another run writes to it.

    Example:
        >>> from pathlib import Path
        >>> suite = export(Path("bench"), count=1, size=16, spp=1, targets=1)
        >>> suite.scenes, suite.views
        (('drawn-0',), ('source', 'yaw010'))
    """
    folder = Path(folder)
    scenes = tuple(f"drawn-{number}" for number in range(count))
    asked = {"seed": seed, "size": size, "spp": spp, "targets": targets}
    files: dict[str, str] = {}
    views: tuple[str, ...] = ()
    with alone_in(folder):
        written = {name: _written(folder, name, asked) for name in scenes}
        for number, name in enumerate(scenes):
            report.step(number, count, name)
            if not written[name]:
                part = Part(report, number, count)
                written[name] = _write_scene(folder, name, number, asked, part)
            files |= written[name]
            views = read_as(Edits, folder / name / EDITS_FILE, AGAIN).views
        sheet = resources.files(__package__).joinpath("datasheet.md").read_text("utf-8")
        words = Template(sheet).substitute(count=count, seed=seed, views=len(views), size=size)
        write_atomic(folder / "README.md", words.encode())
        suite = Suite(FORMAT, seed, size, spp, scenes, views, files)
        text = json.dumps(asdict(suite), indent=1) + "\n"
        write_atomic(folder / FILE, text.encode())
    return suite


def _written(folder: Path, name: str, asked: Mapping[str, int]) -> dict[str, str]:
    """SHA-256 of a finished scene's files by path; empty if it is to be written."""
    path = folder / name / LISTING
    if not path.is_file():
        return {}
    listing = read_as(_Listing, path, f"remove {folder / name} and {AGAIN}")
    if listing.asked != asked:
        raise InputError(f"{folder / name}: has other settings; name another folder")
    return listing.files if not _changed(folder, listing.files) else {}


def _changed(folder: Path, files: Mapping[str, str]) -> Path | None:
    """First file that is lost or changed."""
    paths = {inside(folder, name): digest for name, digest in files.items()}
    return next((p for p, digest in paths.items() if not p.is_file() or sha256(p) != digest), None)


def truth_file(folder: Path, scene: str) -> Path:
    """Path of a scene's definition in a bench."""
    return folder / scene / "truth" / "scene.yaml"


def _write_scene(
    folder: Path, name: str, number: int, asked: Mapping[str, int], report: Reporter
) -> dict[str, str]:
    """Write a scene; return its files' SHA-256 by path."""
    place = folder / name
    (place / LISTING).unlink(missing_ok=True)
    size, spp = asked["size"], asked["spp"]
    data = copy.deepcopy(draw(number, asked["seed"]).data)
    heights = [view["height"] for view in data["cameras"]["targets"]]
    data["cameras"]["targets"] = [
        {"name": view_name(yaw), "yaw": yaw, "height": heights[k % len(heights)]}
        for k, yaw in enumerate(YAWS[: asked["targets"]])
    ]
    data["edits"] = [edit for edit in data["edits"] if edit["name"] in EDITS]
    path = truth_file(folder, name)
    write_atomic(path, to_text(data).encode())
    of = world(str(path), size)
    cameras = list(of.scene.cameras)
    views = [camera.name for camera in cameras]
    images = [place / "images" / f"{view}.png" for view in views]
    for image, view in zip(images, views, strict=True):
        report.step(0, 0, f"{place.name}: {view}")
        write_picture(image, to_bytes(of.image(view, spp)))
        _write_geometry(place, of, view)
    cloud = first_points(of.scene, POINTS, seed=0, geometry=of.geometry)
    dataset = Dataset(cameras, list(images), points=cloud.points, colors=cloud.colors)
    model = splats(str(path), size, 0, **SPLATS)
    write_transforms(place, dataset, points_name="points.ply")
    for name, text in colmap_text(dataset).items():
        write_atomic(place / "sparse" / "0" / name, text.encode())
    write_ply(place / "splats.ply", model)
    for edit in data["edits"]:
        report.step(0, 0, f"{place.name}: {edit['name']}")
        truth = edit_truth(str(path), size, spp, edit["name"], tuple(views))
        for view in views:
            mask = 255 * truth.union[view].astype(np.uint8)
            _write_grey(place / "masks" / edit["name"] / f"{view}.png", mask)
            for answer, pictures in truth.answers.items():
                path_of = place / "truth" / edit["name"] / answer / f"{view}.png"
                write_picture(path_of, to_bytes(pictures[view]))
    told = ("name", "instruction", "source", "target")
    edits = [
        {key: edit[key] for key in told} | {"answers": max(1, len(edit.get("answers", ())))}
        for edit in data["edits"]
    ]
    text = json.dumps({"views": views, "source": views[0], "edits": edits}, indent=1) + "\n"
    write_atomic(place / EDITS_FILE, text.encode())
    held = sorted(path for path in place.rglob("*") if path.is_file())
    files = {path.relative_to(folder).as_posix(): sha256(path) for path in held}
    write_atomic(place / LISTING, json.dumps({"asked": asked, "files": files}).encode())
    return files


def _write_geometry(place: Path, of: World, view: str) -> None:
    depth = of.geometry.trace(of.camera(view)).depth.astype(np.float32)
    _write_array(place / "depth" / f"{view}.npy", depth)
    if view == of.source.name:
        return
    pair = of.between(of.source.name, view)
    shown = np.full(pair.label.shape, 128, np.uint8)
    shown[pair.visible], shown[pair.unseen] = 255, 0
    _write_grey(place / "truth" / "visible" / f"{view}.png", shown)
    _write_array(place / "truth" / "source_pixel" / f"{view}.npy", pair.xy.astype(np.float32))


def _write_grey(path: Path, image: npt.NDArray[np.uint8]) -> None:
    import cv2

    write_atomic(path, bytes(cv2.imencode(".png", image)[1]))


def _write_array(path: Path, array: Any) -> None:
    import io

    buffer = io.BytesIO()
    np.save(buffer, array)
    write_atomic(path, buffer.getvalue())


def to_bytes(image: Any) -> Any:
    """Round (H, W, 3) sRGB in [0, 1] to uint8."""
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def view_name(yaw: int) -> str:
    """Name of a target by its yaw; those clockwise from the source begin with "right".

    Example:
        >>> view_name(30), view_name(-30)
        ('yaw030', 'right030')
    """
    return f"{'yaw' if yaw >= 0 else 'right'}{abs(yaw):03d}"


def colmap_text(dataset: Dataset) -> dict[str, str]:
    """Write a dataset as COLMAP's text model, without tracks: file contents by name.

    https://colmap.github.io/format.html#text-format; pixel centres are at half-integers in both.

    Example:
        >>> from attnwarp import Camera
        >>> camera = Camera.look_at((3, 0, 0), (0, 0, 0), width=8, height=6, fov_y=60, name="a")
        >>> colmap_text(Dataset([camera], [None]))["cameras.txt"].split()[:4]
        ['1', 'PINHOLE', '8', '6']
    """
    cameras, images = [], []
    for number, camera in enumerate(dataset.cameras, start=1):
        K = camera.K
        lens = " ".join(repr(float(v)) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        cameras.append(f"{number} PINHOLE {camera.width} {camera.height} {lens}")
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        pose = [w, x, y, z, *camera.world_to_camera[:3, 3]]
        numbers = " ".join(repr(float(v)) for v in pose)
        images += [f"{number} {numbers} {number} {camera.name}.png", ""]
    return {
        "cameras.txt": "\n".join(cameras) + "\n",
        "images.txt": "\n".join(images) + "\n",
        "points3D.txt": "\n".join(_points(dataset)) + "\n",
    }


def _points(dataset: Dataset) -> Iterator[str]:
    if dataset.points is None or dataset.colors is None:
        return
    for number, (point, color) in enumerate(zip(dataset.points, dataset.colors, strict=True), 1):
        place = " ".join(repr(float(v)) for v in point)
        yield f"{number} {place} {' '.join(str(int(v)) for v in color)} 0"


def sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
