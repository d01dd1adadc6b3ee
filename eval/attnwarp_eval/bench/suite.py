"""Scenes of a bench as files: captures for any method, their truth beside them or sealed.

A sealed bench is drawn from a secret of 256 bits. Its public folder follows from pictures, cameras
and masks alone; the secret and the truth stand in a second folder. The public folder commits to
the truth by hashes salted with the secret, so that the truth can't be exchanged later, nor guessed.
"""

from __future__ import annotations

import copy
import hashlib
import hmac
import json
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
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
from attnwarp.gaussians import Gaussians
from attnwarp.io import Dataset, read_image, write_ply, write_transforms
from attnwarp.io.file import inside
from attnwarp.io.text import read_text
from attnwarp.process import core_count
from attnwarp.reporting import SILENT, Part, Reporter, duration
from attnwarp_eval.canonical_json import read_as
from attnwarp_eval.drawn.asked import BRIGHT
from attnwarp_eval.drawn.draft import GENERATOR
from attnwarp_eval.drawn.files import to_text
from attnwarp_eval.drawn.scenes import draw
from attnwarp_eval.files import write_atomic, write_picture
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.splats.export import first_points
from attnwarp_eval.study.shared.edit_truth import EditTruth, answers_of, edit_truth
from attnwarp_eval.world import World, splats, world

FORMAT: Final = 1
FILE = "bench.json"
EDITS_FILE = "edits.json"

EDITS = ("colour", "some_colour")
"""Edits of each scene: one right answer, and several."""

YAWS = (10, 30, 45, 60, 90, 120, 150, 180, -150, -120, -90, -60, -45, -30, -10)
"""Degrees from the source to each target, both ways around."""

POINTS = 5000
SPLATS = {"kind": "2d", "count": 16_000, "position_noise": 0.1, "normal_noise": 3.0}
"""Splats sampled on the surfaces, as in the studies."""

FIT = {"iterations": 1000, "max_splats": 12_000, "sh_degree": 1, "evaluate_every": 1000}
"""Settings of a sealed bench's splats, fitted to the pictures from random points."""

SECONDS = {"scene": 10.0, "sample": 1.9e-6, "fit": 90.0}
"""CPU seconds of an export: a scene's shapes and splats, a path of its pictures, a sealed fit."""

KEY = "key.json"
LISTING = "truth/files.json"
TIME = 946_684_800
"""Time of a sealed bench's files, 2000-01-01 UTC: the real ones would tell how long each took."""


STRICT = ConfigDict(extra="forbid")
AGAIN = "export or copy the bench again"

Name = Annotated[str, Field(pattern=r"^[\w-][\w .-]*$")]
"""Name of a file or folder in a bench from elsewhere: one that does not lead out of its folder."""


@dataclass(frozen=True, config=STRICT)
class Edit:
    """An edit in a scene's ``edits.json``.

    Attributes:
        name: its name.
        instruction: what to do, in words.
        source: what the scene shows before.
        target: what it shows after.
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
        seed: seed of the drawn scenes; None if sealed.
        size: edge of the pictures, px.
        spp: samples per pixel.
        scenes: names of the scenes.
        views: names of the views, the source first.
        files: SHA-256 of every file by its path.
        sealed: salted hashes of all right answers, sorted; empty if open.
    """

    format: Literal[1]
    seed: int | None
    size: Annotated[int, Field(ge=16, le=1024)]
    spp: Annotated[int, Field(ge=1)]
    scenes: Annotated[tuple[Name, ...], Field(min_length=1)]
    views: Annotated[tuple[Name, ...], Field(min_length=2)]
    files: Mapping[str, str]
    sealed: tuple[str, ...] = ()

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
        for name, digest in suite.files.items():
            path = inside(folder, name)
            if not path.is_file() or _sha256(path) != digest:
                raise InputError(f"{path}: is missing or changed; {AGAIN}")
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
            "views": list(self.views), "sealed": list(self.sealed),
        }  # fmt: skip

    def truth(self, root: Path, scene: str, edit: str) -> tuple[World, EditTruth]:
        """Render the truth of an edit from the scene's file below the truth's folder."""
        path = str(truth_file(root, scene))
        return world(path, self.size), edit_truth(path, self.size, self.spp, edit, self.views)

    def open(self, folder: Path, key: Path | None) -> Path:
        """Return the folder of the truth: of the bench if open, else ``key``.

        Raises:
            InputError: a sealed bench without its key, or with another bench's.
        """
        if not self.sealed:
            return folder
        if key is None:
            raise InputError(f"{folder}: is sealed; its host scores it, with --key")
        try:
            hashes = _salted(key, self.scenes, _secret(key))
        except FileNotFoundError as error:
            raise InputError(f"{key}: lacks {error.filename}, a file of the key") from None
        if hashes != self.sealed:
            raise InputError(f"{key}: is not the key of {folder}; name the one made with it")
        return key


def export(
    folder: Path,
    *,
    count: int = 12,
    seed: int = 0,
    size: int = 256,
    spp: int = 16,
    targets: int = len(YAWS),
    sealed: Path | None = None,
    report: Reporter = SILENT,
) -> Suite:
    """Write a bench of drawn scenes; a folder begun earlier is continued.

    Args:
        folder: output folder.
        count: number of scenes.
        seed: seed of the drawn scenes; unused if sealed.
        size: edge of the pictures, px.
        spp: samples per pixel.
        targets: number of views besides the source.
        sealed: folder for the secret and the truth; None puts the truth beside the pictures.
        report: receiver of progress.

    Raises:
        InputError: the folder has another bench, or the key's folder lies within it.

    Example:
        >>> from pathlib import Path
        >>> suite = export(Path("bench"), count=1, size=16, spp=1, targets=1)
        >>> suite.scenes, suite.views
        (('drawn-0',), ('source', 'yaw010'))
    """
    folder = Path(folder)
    root = folder if sealed is None else Path(sealed)
    if sealed is not None:
        if root.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{root}: lies in the bench, which is given away; name another folder")
        root.mkdir(mode=0o700, parents=True, exist_ok=True)  # each scene's files name the secret
        if not (root / KEY).is_file():
            write_atomic(root / KEY, json.dumps({"secret": secrets.token_hex(32)}).encode())
        seed = _secret(root)
    scenes = tuple(f"drawn-{number}" for number in range(count))
    asked = {"seed": seed, "size": size, "spp": spp, "targets": targets}
    files: dict[str, str] = {}
    views: tuple[str, ...] = ()
    left = sum(not (root / name / LISTING).is_file() for name in scenes)
    cost = _cost(size, spp, targets + 1, sealed is not None)
    time = duration(left * cost / core_count())
    report.log(f"{left} scenes to write: {time}, if {core_count()} cores are free")
    for number, name in enumerate(scenes):
        report.step(number, count, name)
        listing = root / name / LISTING
        if not listing.is_file():
            part = Part(report, number, count)
            _write_scene(folder / name, root / name, number, asked, part)
            place = folder / name
            written = sorted(path for path in place.rglob("*") if path.is_file())
            of_scene = {path.relative_to(folder).as_posix(): _sha256(path) for path in written}
            write_atomic(listing, json.dumps({"asked": asked, "files": of_scene}).encode())
        found = json.loads(read_text(listing))
        if found["asked"] != asked:
            raise InputError(f"{root / name}: has other settings; name another folder")
        files |= found["files"]
        views = read_as(Edits, folder / name / EDITS_FILE, AGAIN).views
    words = _datasheet(count, None if sealed else seed, len(views), size)
    write_atomic(folder / "README.md", words.encode())
    hashes = _salted(root, scenes, seed) if sealed else ()
    suite = Suite(FORMAT, None if sealed else seed, size, spp, scenes, views, files, hashes)
    text = json.dumps(asdict(suite), indent=1) + "\n"
    write_atomic(folder / FILE, text.encode())
    if sealed:
        for path in (*folder.rglob("*"), folder):
            os.utime(path, (TIME, TIME))
    return suite


def _cost(size: int, spp: int, views: int, sealed: bool) -> float:
    """CPU seconds of a scene: a picture before the edits, and one for each right answer."""
    samples = size**2 * spp * views * (1 + 1 + len(BRIGHT))
    return SECONDS["scene"] + SECONDS["sample"] * samples + SECONDS["fit"] * sealed


def truth_file(root: Path, scene: str) -> Path:
    """Path of a scene's definition below the truth's folder."""
    return root / scene / "truth" / "scene.yaml"


def _secret(key: Path) -> int:
    path = key / KEY
    try:
        return int(json.loads(read_text(path))["secret"], 16)
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: holds no secret; the bench can't be opened with it") from None


def _salted(root: Path, scenes: Sequence[str], secret: int) -> tuple[str, ...]:
    """Hashes of every right answer of all scenes, salted with the secret."""
    hashes = []
    for name in scenes:
        scene = load_scene(str(truth_file(root, name)))
        for edit in scene.edits:
            for answer, spec in answers_of(scene, edit.name):
                content = scene.edited(edit.name, spec).content_hash
                hashes.append(salted(f"{name}/{edit.name}/{answer}/{content}", secret))
    return tuple(sorted(hashes))


def salted(text: str, secret: int) -> str:
    """HMAC-SHA256 of a text with a 256-bit secret, in hexadecimal.

    Example:
        >>> salted("a", 1) == salted("a", 2)
        False
    """
    return hmac.new(secret.to_bytes(32, "big"), text.encode(), hashlib.sha256).hexdigest()


def _datasheet(count: int, seed: int | None, views: int, size: int) -> str:
    sheet = resources.files(__package__).joinpath("datasheet.md").read_text("utf-8")
    words = {
        "drawn": f"seed {seed}", "splats": "sampled on the true surfaces",
        "points": "`points.ply`, a rough point cloud", "key": "",
        "truth": "The truth is open, so a method must not be tuned on these scenes.",
    }  # fmt: skip
    if seed is None:
        hidden = ("| `SCENE/depth/", "| `SCENE/truth/")
        sheet = "".join(x for x in sheet.splitlines(True) if not x.startswith(hidden))
        words = {
            "drawn": "from a secret of 256 bits", "splats": "fitted to the pictures",
            "points": "no points", "key": " --key KEY",
            "truth": "The truth is sealed: the host, who has the key, runs this command.",
        }  # fmt: skip
    return Template(sheet).substitute(count=count, views=views, size=size, **words)


def _write_scene(
    place: Path, root: Path, number: int, asked: Mapping[str, int], report: Reporter
) -> None:
    size, spp = asked["size"], asked["spp"]
    data = copy.deepcopy(draw(number, asked["seed"]).data)
    heights = [view["height"] for view in data["cameras"]["targets"]]
    data["cameras"]["targets"] = [
        {"name": view_name(yaw), "yaw": yaw, "height": heights[k % len(heights)]}
        for k, yaw in enumerate(YAWS[: asked["targets"]])
    ]
    data["edits"] = [edit for edit in data["edits"] if edit["name"] in EDITS]
    path = root / "truth" / "scene.yaml"
    write_atomic(path, to_text(data).encode())
    of = world(str(path), size)
    cameras = list(of.scene.cameras)
    views = [camera.name for camera in cameras]
    images = [place / "images" / f"{view}.png" for view in views]
    for image, view in zip(images, views, strict=True):
        report.step(0, 0, f"{place.name}: {view}")
        write_picture(image, to_bytes(of.image(view, spp)))
        _write_geometry(root, of, view)
    dataset = Dataset(cameras, list(images))
    if root == place:
        cloud = first_points(of.scene, POINTS, seed=0, geometry=of.geometry)
        dataset = replace(dataset, points=cloud.points, colors=cloud.colors)
        model = splats(str(path), size, 0, **SPLATS)
    else:
        model = fitted_splats(dataset, root / "fit", report)
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
                path_of = root / "truth" / edit["name"] / answer / f"{view}.png"
                write_picture(path_of, to_bytes(pictures[view]))
    told = ("name", "instruction", "source", "target")
    edits = [
        {key: edit[key] for key in told} | {"answers": max(1, len(edit.get("answers", ())))}
        for edit in data["edits"]
    ]
    text = json.dumps({"views": views, "source": views[0], "edits": edits}, indent=1) + "\n"
    write_atomic(place / EDITS_FILE, text.encode())


def fitted_splats(dataset: Dataset, folder: Path, report: Reporter = SILENT) -> Gaussians:
    """Fit splats to a data set's pictures, from random points; see :data:`FIT`.

    Args:
        dataset: cameras and pictures, without points.
        folder: folder of the fit; one begun earlier is continued.
        report: receiver of progress.
    """
    from attnwarp.fit import FitSettings, Views, first_splats, fit

    settings = FitSettings.from_dict(FIT)
    pictures = [read_image(path) for path in dataset.image_paths if path is not None]
    views = Views(dataset.cameras, pictures)
    start = first_splats(dataset, dataset.cameras, settings, report, views=views)
    return fit(start, views, settings, folder=folder, report=report).gaussians


def _write_geometry(root: Path, of: World, view: str) -> None:
    depth = of.geometry.trace(of.camera(view)).depth.astype(np.float32)
    _write_array(root / "depth" / f"{view}.npy", depth)
    if view == of.source.name:
        return
    pair = of.between(of.source.name, view)
    shown = np.full(pair.label.shape, 128, np.uint8)
    shown[pair.visible], shown[pair.unseen] = 255, 0
    _write_grey(root / "truth" / "visible" / f"{view}.png", shown)
    _write_array(root / "truth" / "source_pixel" / f"{view}.npy", pair.xy.astype(np.float32))


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


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
