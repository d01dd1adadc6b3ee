"""Agreement of neighbouring views of a user's edit, from posed pictures without truth.

The metrics are pure functions of :mod:`attnwarp_eval.metrics`; this module reads the files, and
compares each view with the next in the order of their names. COLMAP reconstructs all of them at
full size; all else is computed on pictures whose longest side is :data:`LONGEST` px, and colours at
every second row and column of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.encoders import Kind
from attnwarp.errors import InputError
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval import metrics
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.metrics.known_geometry import GRID
from attnwarp_eval.study.record import Json, with_nan
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.task import Task, results
from attnwarp_eval.user_images.measure import (
    Figure,
    Inputs,
    Measured,
    Picture,
    Row,
    natural,
    of_views,
    pictures_in,
    read_picture,
    sha256_of,
    usable,
)

LONGEST = 256
"""Longest side in px of pictures, except for COLMAP; smaller ones keep their size."""

PROTOCOL = 3
"""Version; raised when the same pictures would give other figures."""

_FLOW = Figure("consistency.flow_delta_e", "Flow warp error", ("originals",))
_DIRECTION = Figure(
    "embedding.direction_consistency", "CLIP direction consistency", ("originals",), "clip"
)
_MATCHES = Figure("embedding.match_similarity", "DINO match similarity", ("originals",), "dino")
_NEIGHBOURS = Figure("embedding.clip_neighbours", "CLIP between neighbours", ("poses",), "clip")
_REPROJECTION = Figure(
    "consistency.rendered_mae_srgb", "Reprojection loss at rendered depth", ("geometry",)
)
_RENDERED = Figure("consistency.rendered_delta_e", "Colour at rendered depth", ("geometry",))
_EDIT = Figure(
    "consistency.edit_delta_e", "Colour that the edit adds, rendered depth",
    ("geometry", "originals"),
)  # fmt: skip
_FEATURES = Figure("consistency.features", "Features at rendered depth", ("geometry",), "dino")
_PERCEPTUAL = Figure(
    "consistency.perceptual", "Perceptual distance at rendered depth", ("geometry",), "perceptual"
)
_COLMAP = tuple(
    Figure(f"consistency.colmap_{name}", f"COLMAP {title}", ("colmap",))
    for name, title in (
        ("registered", "registered views"),
        ("points", "points"),
        ("track_length", "track length"),
        ("error", "reprojection error"),
        ("failed", "failed"),
    )
)
"""Figures of COLMAP, over all views together."""

FIGURES = (
    _FLOW, _DIRECTION, _MATCHES, _NEIGHBOURS, _EDIT, _RENDERED, _REPROJECTION,
    _FEATURES, _PERCEPTUAL, *_COLMAP,
)  # fmt: skip

_OPTIONS = {
    "poses": "--consistency",
    "geometry": "--ply or --depth",
    "originals": "--originals and --renders",
    "colmap": "--colmap",
}

_FOUND_BY: Mapping[Figure, tuple[str, str]] = {
    _FLOW: ("cv2", "eval"),
    **dict.fromkeys(_COLMAP, ("pycolmap", "colmap")),
}
"""Packages of figures besides the encoders', and the extras that provide them."""


@dataclass(frozen=True)
class _View:
    """A view before pairing, its pictures at full size."""

    edited: Picture
    original: Picture | None
    camera: Camera


def measure_consistency(
    inputs: Inputs,
    encoders: Mapping[Kind, str | None],
    store: Store,
    *,
    device: str = "cpu",
    report: Reporter = SILENT,
) -> Measured:
    """Compute the available figures of each view and the next, and of all views by COLMAP.

    Args:
        inputs: inputs with ``poses``. The judged views are ``renders``, else the pictures of the
            poses; with ``renders``, the pictures before the edit are ``originals``, else the
            pictures of the poses.
        encoders, store, device, report: as for :func:`attnwarp_eval.user_images.measure.measure`.

    Raises:
        InputError: poses or pictures that cannot be read, fewer than two views, or a picture of
            another shape than its camera.
    """
    done = Measured(inputs)
    cameras, posed, edited, originals = _files(inputs, done)
    names = list(edited)
    given = {
        "poses": True,
        "geometry": inputs.ply is not None or inputs.depth is not None,
        "originals": bool(originals),
        "colmap": inputs.colmap,
    }
    lacking = {need: option for need, option in _OPTIONS.items() if not given[need]}
    wanted, loaded = usable(FIGURES, lacking, _not_installed, encoders, device, done)
    together = [figure for figure in wanted if figure in _COLMAP]
    wanted = [figure for figure in wanted if figure not in _COLMAP]
    pairs = _Pairs(inputs, cameras, posed, edited, originals, wanted, loaded)
    tasks = (_task(pairs, inputs, one, two, device) for one, two in itertools.pairwise(names))
    values: dict[Figure, dict[str, float]] = {figure: {} for figure in wanted}
    for (one, two), found in zip(
        itertools.pairwise(names), results(store, tasks, len(names) - 1, report), strict=True
    ):
        for figure in wanted:
            values[figure][f"{one} to {two}"] = found[figure.key]
    for figure in wanted:
        row = values[figure]
        done.rows.append(Row(figure.key, figure.title, of_views(row), row, figure.encoder))
    if together:
        (found,) = results(store, [_reconstruction(pairs, names)], 1, report)
        every = f"all {len(names)}"
        done.rows += [Row(f.key, f.title, found[f.key], {every: found[f.key]}) for f in together]
    return done


def _not_installed(figure: Figure) -> str:
    from importlib.util import find_spec

    package, extra = _FOUND_BY.get(figure, ("", ""))
    if not package or find_spec(package) is not None:
        return ""
    return f"needs the package {package}; install attnwarp[{extra}]"


def _files(
    inputs: Inputs, done: Measured
) -> tuple[dict[str, Camera], dict[str, Path], dict[str, Path], dict[str, Path]]:
    """Cameras and their pictures by name; pictures after the edit and before it likewise, in
    natural order.
    """
    from attnwarp.io import read_dataset
    from attnwarp.io.names import file_stems

    assert inputs.poses is not None
    try:
        dataset = read_dataset(
            inputs.poses, points=False, missing_images="none", resize_cameras=True
        )
    except (FileNotFoundError, ValueError) as error:
        raise InputError(f"--consistency: {error}") from None
    stems = file_stems(dataset.cameras)
    cameras = dict(zip(stems, dataset.cameras, strict=True))
    posed = {
        stem: path
        for stem, path in zip(stems, dataset.image_paths, strict=True)
        if path is not None
    }
    folders = {
        name: pictures_in(getattr(inputs, name), f"--{name}")
        for name in ("renders", "originals")
        if getattr(inputs, name) is not None
    }
    edited = folders.get("renders", posed)
    originals = folders.get("originals", posed if "renders" in folders else {})
    names = sorted((name for name in edited if name in cameras), key=natural)
    lone = [name for name in edited if name not in cameras]
    if lone:
        done.unpaired.append(
            f"{len(lone)} pictures without a camera of their name in --consistency: {lone[0]} first"
        )
    if originals and (lacking := [name for name in names if name not in originals]):
        done.unpaired.append(
            f"{len(lacking)} views without a picture before the edit, left out: {lacking[0]} first"
        )
        names = [name for name in names if name in originals]
    if len(names) < 2:
        raise InputError(
            f"--consistency: {len(names)} pictures have a camera of their name, expected at least"
            f" 2; cameras are named {', '.join(list(cameras)[:3])}, pictures"
            f" {', '.join(list(edited)[:3])}"
        )
    originals = {name: originals[name] for name in names if originals}
    return cameras, posed, {name: edited[name] for name in names}, originals


class _Pairs:
    """Figures of two neighbouring views; a view's results are kept for its second pair."""

    def __init__(
        self,
        inputs: Inputs,
        cameras: Mapping[str, Camera],
        posed: Mapping[str, Path],
        edited: Mapping[str, Path],
        originals: Mapping[str, Path],
        wanted: Sequence[Figure],
        loaded: Mapping[Kind, Any],
    ) -> None:
        self.inputs, self.cameras, self.posed = inputs, cameras, posed
        self.edited, self.originals = edited, originals
        self.wanted, self.loaded = tuple(wanted), loaded
        self._view: Callable[[str], _View] = lru_cache(maxsize=2)(self._read)
        self._small: Callable[[str], _View] = lru_cache(maxsize=2)(self._reduced)
        self._surface = lru_cache(maxsize=2)(self._rendered)
        self._encoded = lru_cache(maxsize=16)(self._features)

    def figures(self, one: str, two: str) -> dict[str, float]:
        """Figures of a view and the next, by key; NaN where undefined."""
        values: dict[str, float] = {}
        a, b = self._small(one), self._small(two)
        if _FLOW in self.wanted:
            values[_FLOW.key] = _along_flow(a, b)
        if _DIRECTION in self.wanted:
            before, after = (
                np.stack([self._encoded("clip", name, old) for name in (one, two)])
                for old in (True, False)
            )
            values[_DIRECTION.key] = metrics.direction_consistency(before, after).mean
        if _NEIGHBOURS in self.wanted:
            first, second = (self._encoded("clip", name, False)[None] for name in (one, two))
            values[_NEIGHBOURS.key] = metrics.image_similarity(first, second).mean
        if _MATCHES in self.wanted:
            tokens = [
                self._encoded("dino", name, old).reshape(-1, self.loaded["dino"].about.dim)
                for old in (True, False)
                for name in (one, two)
            ]
            values[_MATCHES.key] = metrics.match_similarity(*tokens).mean
        if _RENDERED in self.wanted:
            values |= self._at_depth(one, two)
        return {figure.key: values[figure.key] for figure in self.wanted}

    def _at_depth(self, one: str, two: str) -> dict[str, float]:
        from attnwarp.warp import PRESETS, warp_surfaces

        a, b = self._small(one), self._small(two)
        settings = PRESETS["corrected"]
        if self.inputs.depth is not None:  # which has no normals
            settings = replace(settings, normal_test="none")
        view = warp_surfaces(
            a.camera, b.camera, self._surface(two), self._surface(one), settings, warn_empty=False
        )
        where = view.correspondence.xy.numpy(), view.mask.numpy()
        thinned = where[0][GRID], where[1][GRID]
        values = metrics.disagreement_at(a.edited, b.edited[GRID], *thinned).figures("rendered_")
        if _EDIT in self.wanted:
            assert a.original is not None and b.original is not None
            before, after = (a.original, b.original[GRID]), (a.edited, b.edited[GRID])
            values[_EDIT.key] = metrics.edit_agreement(before, after, *thinned)[_EDIT.key]
        if _FEATURES in self.wanted:
            dino = self.loaded["dino"]
            first, second = (self._encoded("dino", name, False) for name in (one, two))
            size = a.edited.shape[:2]
            values[_FEATURES.key] = 1 - (
                metrics.feature_consistency(
                    first, second, *where, size, seen=dino.preprocess.seen
                ).mean
            )
        if _PERCEPTUAL in self.wanted:
            network = self.loaded["perceptual"]
            values[_PERCEPTUAL.key] = metrics.perceptual_consistency(
                a.edited, b.edited, *where, lambda x, y: float(network.distance([x], [y])[0])
            )
        return values

    def _read(self, name: str) -> _View:
        edited, original = (
            read_picture(files[name], self.inputs.background, beside=self.posed.get(name))
            if name in files
            else None
            for files in (self.edited, self.originals)
        )
        assert edited is not None
        camera, (height, width) = self.cameras[name], edited.shape[:2]
        for path, image in ((self.edited[name], edited), (self.originals.get(name), original)):
            if image is not None:
                try:
                    check.same_aspect(
                        image.shape[:2],
                        (camera.height, camera.width),
                        str(path),
                        "crop it as its camera sees it",
                    )
                except ValueError as error:
                    raise InputError(str(error)) from None
        return _View(edited, original, camera.resize(width, height))

    def _reduced(self, name: str) -> _View:
        view = self._view(name)
        height, width = view.edited.shape[:2]
        share = min(1.0, LONGEST / max(height, width))
        size = (max(1, round(width * share)), max(1, round(height * share)))
        edited, original = (
            None if image is None else _shrunk(image, size)
            for image in (view.edited, view.original)
        )
        assert edited is not None
        return _View(edited, original, view.camera.resize(*size))

    def _rendered(self, name: str) -> Any:
        from attnwarp.warp import Surface, render_surface, resize_depth

        camera = self._small(name).camera
        if self.inputs.depth is None:
            return render_surface(self.splats, camera)
        path = _depths(self.inputs.depth, name)[name]
        try:
            depth = np.load(path)
            return Surface(resize_depth(depth, (camera.height, camera.width)))
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"--depth: {path}: expected (H, W) depths ({error})") from None

    @cached_property
    def splats(self) -> Any:
        """Splats before the edit."""
        from attnwarp.io import read_ply, read_splat

        path = self.inputs.ply
        assert path is not None
        return (read_splat if path.suffix.lower() == ".splat" else read_ply)(path)

    def _features(self, kind: Kind, name: str, before: bool) -> npt.NDArray[np.float64]:
        view = self._small(name)
        image = view.original if before else view.edited
        encoder = self.loaded[kind]
        encode = encoder.images if kind == "clip" else encoder.tokens
        return np.asarray(encode([image])[0])


def _shrunk(image: Picture, size: tuple[int, int]) -> Picture:
    import cv2

    if image.shape[1::-1] == size:
        return image
    return np.clip(cv2.resize(image, size, interpolation=cv2.INTER_AREA), 0, 1).astype(np.float32)


def _along_flow(one: _View, two: _View) -> float:
    """dE00 along the flow of the originals; NaN for two views of different sizes."""
    assert one.original is not None and two.original is not None
    if len({image.shape for image in (one.original, two.original, one.edited, two.edited)}) > 1:
        return float("nan")
    flow = metrics.optical_flow(one.original, two.original)
    result = metrics.disagreement_at(
        one.edited, two.edited[GRID], flow.xy[GRID], flow.accepted[GRID]
    )
    return result.figures("flow_")[_FLOW.key]


def _reconstruction(pairs: _Pairs, names: Sequence[str]) -> Task[dict[str, float]]:
    """Reconstruct all views as one scene, at full size."""
    spec = {
        "probe": "user reconstruction",
        "protocol": PROTOCOL,
        "edited": [_sha256(pairs.edited[name]) for name in names],
        "posed": [_sha256(pairs.posed[name]) for name in names if name in pairs.posed],
        "intrinsics": [pairs.cameras[name].K.tolist() for name in names],
        "background": list(pairs.inputs.background),
    }

    def compute(report: Reporter) -> Json:
        views = [pairs._read(name) for name in names]
        found = metrics.reconstruct([v.edited for v in views], [v.camera for v in views])
        return {"figures": without_nan(found.figures())}

    return Task("COLMAP", spec, compute, lambda record: with_nan(record["figures"]))


def _task(pairs: _Pairs, inputs: Inputs, one: str, two: str, device: str) -> Task[dict[str, float]]:
    def hashed(files: Mapping[str, Path]) -> list[str]:
        return [_sha256(files[name]) for name in (one, two) if name in files]

    spec = {
        "probe": "user consistency",
        "protocol": PROTOCOL,
        "edited": hashed(pairs.edited),
        "originals": hashed(pairs.originals),
        "posed": hashed(pairs.posed),
        "cameras": [pairs.cameras[name].to_dict() for name in (one, two)],
        "ply": None if inputs.ply is None else _sha256(inputs.ply),
        "depth": None if inputs.depth is None else hashed(_depths(inputs.depth, one, two)),
        "figures": [figure.key for figure in pairs.wanted],
        "encoders": {kind: pairs.loaded[kind].about.to_dict() for kind in sorted(pairs.loaded)},
        "background": list(inputs.background),
        "device": device,
    }
    return Task(
        f"{one} to {two}",
        spec,
        lambda tell: {"figures": without_nan(pairs.figures(one, two))},
        lambda record: with_nan(record["figures"]),
    )


def _depths(folder: Path, *names: str) -> dict[str, Path]:
    return {name: folder / f"{name}.npy" for name in names}


_sha256 = lru_cache(maxsize=512)(sha256_of)
