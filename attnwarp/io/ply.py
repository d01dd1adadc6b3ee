"""PLY files: splats in the format of 2DGS and 3DGS trainers and viewers, and point clouds.

Properties of a splat file, in the order of the original trainers: ``x y z``, ``nx ny nz`` (zeros),
``f_dc_0..2``, ``f_rest_*`` (all coefficients of red, then green, then blue), ``opacity`` (logit),
``scale_0..1`` for 2DGS or ``scale_0..2`` for 3DGS (natural logarithm), ``rot_0..3`` (wxyz, any
length). Header comments carry further values; docs/method/files.md lists them and the other
programs that write them.
"""

from __future__ import annotations

import math
import mmap
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.errors import InputWarning
from attnwarp.gaussians import LARGEST_FILTER, LEAST_FILTER, SCREEN_FILTER, Gaussians, Kind
from attnwarp.io.file import FileFormatError, existing_file, write_atomically
from attnwarp.io.packed import packed_format, turn, unpack
from attnwarp.io.ply_elements import PlyError, parse_ply, write_vertices

Array = npt.NDArray[np.float64]
Columns = dict[str, npt.NDArray[Any]]

THIRD_SCALE = 1e-6
"""Third scale, in scene units, that turns a 2D splat into one that viewers of 3D splats show.

The authors of 2DGS recommend this value (hbb1/2d-gaussian-splatting, issue 94). A file whose third
scales all equal it exactly is read back as 2D.
"""

WORLD_TOLERANCE = 0.01
"""Largest displacement of a splat by float32 world coordinates, as a share of its largest scale: a
hundredth of a standard deviation changes no pixel by more than 0.6 % of the splat's peak.
"""

Coordinates = Literal["auto", "world", "relative"]

COLORS = ("red", "green", "blue")
"""Names of a point's colours."""

FILTER_3D = "filter_3D"
"""Property specific to Mip-Splatting's files."""

MIP_SCREEN_FILTER = 0.1
"""Mip-Splatting's screen filter, px^2 (its ``kernel_size``)."""

LOGIT_OF_ZERO = -120.0
LOGIT_OF_ONE = 40.0
"""Logits written for opacity 0 and 1, whose exact logits are infinite.

Their sigmoids are exactly 0 and 1 in float32 (and 1 in float64), beyond every logit of a float32
opacity strictly between 0 and 1 (-103.3 to 16.6): no other opacity maps to 0 or 1, and the file has
no infinite values.
"""


def read_ply(
    path: str | os.PathLike[str],
    *,
    kind: Kind | None = None,
    antialiased: bool | None = None,
    screen_filter: float | None = None,
) -> Gaussians:
    """Read splats.

    ASCII and binary PLY of either byte order are read, and with the extra ``formats`` compressed
    PLY, SPZ, SOG and KSPLAT, which hold 3DGS alone; further properties and elements are ignored.
    The first applicable rule determines the kind:

    1. ``kind``, or a comment's kind (``attnwarp kind 2d``, ``SplatRenderMode: 2dgs``);
    2. 2D without ``scale_2``, or if every ``scale_2`` is the logarithm of :data:`THIRD_SCALE`;
    3. 3D. A constant third scale that is in every row at most a hundredth of both others is
       ambiguous and is refused without ``kind``.

    For the 2D kind a third scale is dropped.

    In Mip-Splatting's files ``filter_3D``, the standard deviation of each splat's smoothing filter,
    is merged into scales and opacities (Yu et al. 2024, the 3D smoothing filter).

    Args:
        path: path of the file.
        kind: "2d" or "3d" to override the rules above.
        antialiased: value that overrides the comments ``SplatRenderMode: mip|default`` and
            ``antialiased 1|0``; without either, True for Mip-Splatting's files, else False.
        screen_filter: px^2, overrides the comment ``attnwarp screen_filter``; without it,
            Mip-Splatting's 0.1 if the file has a ``filter_3D``, else 3DGS's 0.3. Other programs
            that write ``filter_3D``, such as GOF and RaDe-GS, have no screen filter: pass 1e-4.

    Returns:
        Gaussians in float32. Double ``x y z`` that float32 cannot represent and that lie farther
        from zero than twice the extent of the scene become float32 means relative to a rounded
        ``origin``. Logits of +-inf become opacity 1 and 0; all other values must be finite.

    Raises:
        FileNotFoundError: the file does not exist.
        FileFormatError: the file is not a splat file, a property is missing, or a value is out of
            range; the message names the argument of :class:`Gaussians` and the first bad row.

    Example:
        >>> from attnwarp.io import read_ply, write_ply
        >>> from attnwarp.trial import disc
        >>> write_ply("disc.ply", disc())
        >>> read_ply("disc.ply").scales
        tensor([[0.5000, 0.5000]])
    """
    path = existing_file(path)
    if kind is not None:
        check.one_of(kind, ("2d", "3d"), "kind")
    if packed := packed_format(path):
        if kind == "2d":
            raise FileFormatError(path, "holds 3DGS alone; leave kind='2d' (--kind 2dgs) out")
        columns, comments = _read_packed(path, packed)
        kind = "3d"
    else:
        columns, comments = _read_vertices(path)
    _refuse_other_formats(path, columns)
    header = _read_comments(path, comments)
    xyz = _stack(path, columns, ("x", "y", "z"), np.float64)
    logits = _stack(path, columns, ("opacity",), np.float64)[:, 0]
    kind, names = _recognise(path, columns, header, kind)
    with np.errstate(over="ignore"):
        scales = np.exp(_stack(path, columns, names, np.float64)).astype(np.float32)
        alpha = 1.0 / (1.0 + np.exp(-logits))
    flags, default = (antialiased, header.antialiased, False), SCREEN_FILTER
    merged = FILTER_3D in columns and kind == "3d"
    if merged:
        scales, share = _filtered(columns[FILTER_3D], scales)
        alpha *= share
        flags, default = (antialiased, header.antialiased, True), MIP_SCREEN_FILTER
    antialiased = next(flag for flag in flags if flag is not None)
    width = next(w for w in (screen_filter, header.screen_filter, default) if w is not None)
    if merged:
        _warn(
            f"{path}: is of Mip-Splatting: its {FILTER_3D} is merged into scales and opacities, and"
            f" the splats are {'' if antialiased else 'not '}rendered antialiased, with a screen"
            f" filter of {width:g} px^2; of another program, such as GOF, give its own by"
            " screen_filter (--screen-filter)"
        )
    try:
        check.finite(xyz, "x, y, z")
        offset, means = split_origin(xyz)
        return Gaussians(
            kind,
            torch.from_numpy(means),
            torch.from_numpy(_stack(path, columns, _names("rot", 4), np.float32)),
            torch.from_numpy(scales),
            torch.from_numpy(alpha.astype(np.float32)),
            torch.from_numpy(_read_sh(path, columns)),
            origin=header.origin + offset,
            antialiased=antialiased,
            screen_filter=width,
            far=header.far,
        )
    except FileFormatError:
        raise
    except ValueError as error:
        raise FileFormatError(path, f"{error}; the file is damaged, or the fit diverged") from None


def write_ply(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    third_scale: float | None = None,
    coordinates: Coordinates = "auto",
) -> None:
    """Write splats as binary little-endian PLY, all properties float32, atomically.

    A round trip keeps the bits of quaternions, spherical harmonics, kind and the antialias flag.
    Opacities 0 and 1 are exact. Other opacities and the scales pass through a float32 logarithm,
    with an error below 4e-6 of their value. Means are written as world coordinates rounded to
    float32, as other programs expect; with an origin they keep their bits.

    Args:
        path: path of the file; an older file is replaced.
        gaussians: splats to write.
        third_scale: third scale (scene units) written for the 2D kind, for viewers that support
            only 3D splats; :data:`THIRD_SCALE` is usual. None writes two scales, as 2DGS trainers
            do.
        coordinates: "world" for world coordinates; "relative" for means relative to the model's
            origin, which is written to a header comment that only this package reads; "auto" for
            world coordinates unless float32 would move a splat by more than
            :data:`WORLD_TOLERANCE`.

    Warns:
        InputWarning: "auto" writes an origin, or "world" moves splats by more than
            :data:`WORLD_TOLERANCE`.

    Raises:
        ValueError: a value of ``gaussians`` is out of range (not finite, a zero quaternion),
            ``third_scale`` is not positive or is given for the 3D kind, or a world coordinate does
            not fit float32.

    Example:
        >>> from attnwarp.io import read_ply, write_ply
        >>> from attnwarp.trial import disc
        >>> write_ply("disc.ply", disc())
        >>> read_ply("disc.ply").means.tolist()
        [[0.0, 0.0, 0.0]]
    """
    # Fields may have been assigned or trained since the checks, and float64 may exceed the
    # file's float32, so replace() runs the checks again.
    original = gaussians.detach().to(device="cpu")
    g = replace(original.to(dtype=torch.float32))
    scales = g.scales.numpy().astype(np.float64)
    if third_scale is not None:
        if g.kind != "2d":
            raise ValueError(
                f"third_scale: got {third_scale} for splats of kind '3d', expected None"
            )
        if not (np.isfinite(third_scale) and third_scale > 0):
            raise ValueError(
                f"third_scale: got {third_scale}, expected a positive length such as {THIRD_SCALE}"
            )
        scales = np.concatenate([scales, np.full((len(g), 1), third_scale)], axis=1)
    origin, means = _place(Path(path), original, coordinates)
    sh = g.sh.numpy()
    # (N, K, 3) -> (N, 3, K): the trainers flatten channel by channel.
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(g), 3 * (sh.shape[1] - 1))
    parts: list[tuple[Sequence[str], npt.NDArray[Any]]] = [
        (("x", "y", "z"), means),
        (("nx", "ny", "nz"), np.zeros((len(g), 3))),
        (_names("f_dc", 3), sh[:, 0]),
        (_names("f_rest", rest.shape[1]), rest),
        (("opacity",), _logit(g.opacities.numpy())[:, None]),
        (_names("scale", scales.shape[1]), np.log(scales)),
        (_names("rot", 4), g.quats.numpy()),
    ]
    comments = [f"attnwarp kind {g.kind}"]
    if origin.any():
        comments += ["attnwarp origin " + " ".join(repr(float(v)) for v in origin)]
    if g.kind == "2d":
        comments += ["SplatRenderMode: 2dgs", *(["antialiased 1"] if g.antialiased else [])]
    else:
        comments += [f"SplatRenderMode: {'mip' if g.antialiased else 'default'}"]
        if g.screen_filter != SCREEN_FILTER:
            comments += [f"attnwarp screen_filter {g.screen_filter!r}"]
    if np.isfinite(g.far):
        comments += [f"attnwarp far {g.far!r}"]
    _write_vertices(path, [(names, "<f4", block) for names, block in parts], comments)


def read_points(path: str | os.PathLike[str]) -> tuple[Array, npt.NDArray[np.uint8] | None]:
    """Read a point cloud, such as the initial points of a dataset.

    Args:
        path: path of a PLY file with ``x y z``.

    Returns:
        points: (P, 3) float64.
        colors: (P, 3) uint8 from ``red green blue``; None if the file has no colours.

    Raises:
        FileNotFoundError: the file does not exist.
        FileFormatError: the file is not a PLY, is truncated, lacks ``x y z``, or has a non-finite
            value or colours that are not uchar.

    Example:
        >>> from attnwarp.io import read_points, write_points
        >>> write_points("points.ply", [[0.1, 0.2, 0.3]])
        >>> points, colors = read_points("points.ply")
        >>> points.tolist(), colors  # doubles, and no colours
        ([[0.1, 0.2, 0.3]], None)
    """
    path = existing_file(path)
    columns, _ = _read_vertices(path)
    points = _stack(path, columns, ("x", "y", "z"), np.float64)
    if not np.isfinite(points).all():
        raise FileFormatError(
            path, "not every point is finite; get the file again", field="x, y, z"
        )
    if not set(COLORS) & set(columns):
        return points, None
    for name in COLORS:
        _check_there(path, columns, name)
        if columns[name].dtype.kind not in "iu" or columns[name].dtype.itemsize != 1:
            raise FileFormatError(
                path, f"got type {columns[name].dtype.name}, expected uchar (0 to 255)", field=name
            )
    return points, np.stack([columns[name] for name in COLORS], axis=1).astype(np.uint8)


def write_points(
    path: str | os.PathLike[str], points: npt.ArrayLike, colors: npt.ArrayLike | None = None
) -> None:
    """Write a point cloud as binary little-endian PLY with double ``x y z``, atomically.

    Args:
        path: path of the file; an older file is replaced.
        points: (P, 3) finite points.
        colors: (P, 3) uint8, optional.

    Raises:
        ValueError: wrong shape, a non-finite point, or colours that are not uint8.

    Example:
        >>> import numpy as np
        >>> from attnwarp.io import read_points, write_points
        >>> write_points("points.ply", [[0.1, 0.2, 0.3]], np.array([[255, 128, 0]], np.uint8))
        >>> read_points("points.ply")[1].tolist()
        [[255, 128, 0]]
    """
    xyz = np.asarray(points, dtype=np.float64)
    check.shape(xyz, ("P", 3), "points")
    check.finite(xyz, "points")
    parts: list[tuple[Sequence[str], str, npt.NDArray[Any]]] = [("xyz", "<f8", xyz)]
    if colors is not None:
        rgb = np.asarray(colors)
        check.shape(rgb, (len(xyz), 3), "colors")
        if rgb.dtype != np.uint8:
            raise ValueError(f"colors: got {rgb.dtype}, expected uint8")
        parts.append((COLORS, "u1", rgb))
    _write_vertices(path, parts)


# --------------------------------------------------------------------------------------------------


def _write_vertices(
    path: str | os.PathLike[str],
    parts: Sequence[tuple[Sequence[str], str, npt.NDArray[Any]]],
    comments: Sequence[str] = (),
) -> None:
    """Write columns, each part's names, numpy's type and (N, names) values, atomically."""
    kinds = [(name, kind) for names, kind, _ in parts for name in names]
    rows = np.empty(len(parts[0][2]), dtype=kinds)
    for names, _, block in parts:
        for i, name in enumerate(names):
            rows[name] = block[:, i]
    write_atomically(path, lambda stream: write_vertices(stream, rows, comments), follow_link=True)


def _names(stem: str, count: int) -> tuple[str, ...]:
    return tuple(f"{stem}_{i}" for i in range(count))


def _read_packed(path: Path, packed: str) -> tuple[Columns, list[str]]:
    """Read splats of another format as columns of a PLY."""
    data, comments = unpack(path, packed)
    columns, _ = _read_vertices(path, data)
    if packed == "ksplat" and "f_rest_9" in columns:
        raise FileFormatError(
            path,
            "has harmonics beyond degree 1, which programs order in different ways; export degree 1"
            " at most, or SPZ",
        )
    return turn(columns) if packed == "spz" else columns, comments


def _read_vertices(path: Path, data: Any = None) -> tuple[Columns, list[str]]:
    """Read the scalar columns of the element ``vertex``, and all header comments."""
    if data is None:
        with path.open("rb") as stream:
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    try:
        elements, comments = parse_ply(data)
    except PlyError as error:
        raise FileFormatError(path, str(error), field=error.name, row=error.row) from None
    if "vertex" not in elements:
        raise FileFormatError(
            path, f"no element 'vertex' (elements: {', '.join(elements) or 'none'})", field="vertex"
        )
    columns = elements["vertex"].scalars()
    # CloudCompare stores unknown properties as scalar fields of these names.
    return {
        name.removeprefix("scalar_"): column for name, column in columns.items()
    } | columns, comments


def _refuse_other_formats(path: Path, columns: Columns) -> None:
    if "x" in columns and not any(name in columns for name in ("opacity", "scale_0", "rot_0")):
        raise FileFormatError(
            path,
            "missing; this looks like a point cloud and not like splats (read it with"
            " attnwarp.io.read_points)",
            field="opacity",
        )


def _check_there(path: Path, columns: Columns, name: str) -> None:
    if name not in columns:
        raise FileFormatError(
            path,
            f"missing (the file has: {', '.join(columns)}); export the whole model again",
            field=name,
        )


def _stack(
    path: Path, columns: Columns, names: Sequence[str], dtype: type[np.floating[Any]]
) -> npt.NDArray[Any]:
    """Stack properties as (N, names) of a type; values too large for it become infinite."""
    for name in names:
        _check_there(path, columns, name)
    with np.errstate(over="ignore"):
        return np.stack([columns[name].astype(dtype) for name in names], axis=1)


def _filtered(
    width: npt.NDArray[Any], scales: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], Array]:
    """Merge the 3D filter: (N, 3) smoothed scales, and the (N,) remaining factor of opacities.

    The filter's covariance is added and the splat keeps its mass, so its peak falls by the square
    root of the ratio of determinants.
    """
    before = scales.astype(np.float64) ** 2
    after = before + width.astype(np.float64)[:, None] ** 2
    return np.sqrt(after).astype(np.float32), np.sqrt((before / after).prod(axis=1))


def _read_sh(path: Path, columns: Columns) -> npt.NDArray[np.float32]:
    dc = _stack(path, columns, _names("f_dc", 3), np.float32)
    count = sum(name.startswith("f_rest_") for name in columns)
    if count not in (0, 9, 24, 45):
        raise FileFormatError(
            path,
            f"got {count} coefficients, expected 0, 9, 24 or 45 (spherical harmonics of degree 0 to"
            " 3, three channels); write the file again with one of these degrees",
            field="f_rest_*",
        )
    if not count:
        return dc[:, None]
    rest = _stack(path, columns, _names("f_rest", count), np.float32)
    rest = rest.reshape(len(dc), 3, count // 3).transpose(0, 2, 1)
    return np.concatenate([dc[:, None], rest], axis=1)


@dataclass
class _Header:
    """Header comments about the splats; of two that contradict each other the last counts."""

    kind: Kind | None = None
    antialiased: bool | None = None
    origin: Array = field(default_factory=lambda: np.zeros(3))
    screen_filter: float | None = None
    far: float = math.inf


def _read_comments(path: Path, comments: list[str]) -> _Header:
    header = _Header()
    for comment in comments:
        try:
            match comment.lower().split():
                case ["attnwarp", "kind", ("2d" | "3d") as kind]:
                    header.kind = kind
                case ["attnwarp", "origin", x, y, z]:
                    header.origin = np.array([float(v) for v in (x, y, z)])
                    check.finite(header.origin, "origin")
                case ["attnwarp", "screen_filter", number]:
                    header.screen_filter = check.number(
                        float(number), LEAST_FILTER, LARGEST_FILTER, "screen_filter"
                    )
                case ["attnwarp", "far", number]:
                    header.far = float(number)
                case ["attnwarp", *_]:
                    raise ValueError("not known to this version")
                # Some files have no space between colon and tag.
                case ["splatrendermode:" | "splatrendermode", "2dgs"]:
                    header.kind = "2d"
                case ["splatrendermode:" | "splatrendermode", ("mip" | "default") as mode]:
                    header.antialiased = mode == "mip"
                case ["antialiased", ("0" | "1") as flag]:
                    header.antialiased = flag == "1"
        except ValueError as error:
            raise FileFormatError(path, f"damaged comment {comment!r}: {error}") from None
    return header


def _recognise(
    path: Path, columns: Columns, header: _Header, kind: Kind | None
) -> tuple[Kind, tuple[str, ...]]:
    """Determine the kind of the splats and the names of its scales."""
    for name in ("scale_0", "scale_1"):
        _check_there(path, columns, name)
    kind = kind or header.kind or _kind_by_scales(path, columns)
    if kind == "2d":
        return "2d", ("scale_0", "scale_1")
    if "scale_2" not in columns:
        raise FileFormatError(
            path,
            "missing for splats of kind '3d'; a file with two scales holds 2D splats: pass"
            " kind='2d' (--kind 2dgs)",
            field="scale_2",
        )
    return "3d", ("scale_0", "scale_1", "scale_2")


def _kind_by_scales(path: Path, columns: Columns) -> Kind:
    if "scale_2" not in columns:
        return "2d"
    third = columns["scale_2"]
    if len(third) == 0:
        return "3d"
    if (third.astype(np.float32) == np.float32(np.log(THIRD_SCALE))).all():
        return "2d"
    flattest = np.minimum(columns["scale_0"], columns["scale_1"])
    if len(third) > 1 and (third == third[0]).all() and (third <= flattest + np.log(0.01)).all():
        raise FileFormatError(
            path,
            f"{third[0]} in every row, at most a hundredth of the other scales: flat 3D splats, or"
            " 2D ones written for a 3D viewer; pass kind='2d' or kind='3d' (--kind)",
            field="scale_2",
        )
    return "3d"


def world_error(gaussians: Gaussians) -> Array:
    """Compute each splat's shift by float32 world coordinates over its largest scale, (N,)."""
    exact = gaussians.world_means()
    with np.errstate(over="ignore", invalid="ignore"):
        moved = np.abs(exact.astype(np.float32) - exact)
    largest = gaussians.scales.detach().cpu().numpy().astype(np.float64)
    return moved.max(axis=1, initial=0) / largest.max(axis=1, initial=1e-300)


def _place(
    path: Path, g: Gaussians, coordinates: Coordinates
) -> tuple[Array, npt.NDArray[np.float32]]:
    """Return the file's origin, and the float32 means relative to it."""
    check.one_of(coordinates, get_args(Coordinates), "coordinates")
    error = world_error(g)
    moved = int((~(error <= WORLD_TOLERANCE)).sum())
    if coordinates == "relative" or (coordinates == "auto" and moved):
        offset, means = split_origin(g.means.numpy())
        origin = g.origin + offset
        if coordinates == "auto":
            _warn(
                f"{path}: means are relative to the comment 'attnwarp origin"
                f" {' '.join(repr(float(v)) for v in origin)}', and other programs will show the"
                f" splats around zero: float32 world coordinates would move {moved} of {len(g)} by"
                f" more than {WORLD_TOLERANCE:g} of their scale; coordinates='world' (--coordinates"
                " world) writes those"
            )
        return origin, means
    with np.errstate(over="ignore"):
        means = g.world_means().astype(np.float32)
    check.finite(means, "means (world coordinates in float32)")
    if moved:
        _warn(
            f"{path}: float32 world coordinates move {moved} of {len(g)} splats by more than"
            f" {WORLD_TOLERANCE:g} of their scale, up to {error.max():.3g} of it"
        )
    return np.zeros(3), means


def _warn(message: str) -> None:
    warnings.warn(message, InputWarning, stacklevel=4)


def split_origin(points: npt.NDArray[np.floating[Any]]) -> tuple[Array, npt.NDArray[np.float32]]:
    """Split float64 (N, 3) points into an origin and float32 means with points = origin + means.

    The origin is zero if float32 represents the points exactly, or if none lies farther from zero
    than twice the longest side of their bounding box, where a shift gains at most two bits.
    Otherwise it is the centre of the box, rounded to a power of ten no larger than half that side
    for a readable header; float32 then resolves the scene to 2^-24 of its extent.
    """
    xyz = np.asarray(points, dtype=np.float64)
    with np.errstate(over="ignore"):
        rounded = xyz.astype(np.float32)
    if len(xyz) == 0 or np.array_equal(rounded, xyz):
        return np.zeros(3), rounded
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    half = float((high - low).max()) / 2
    if np.abs(xyz).max() <= 4 * half:
        return np.zeros(3), rounded
    centre = low + (high - low) / 2
    if half > 0:
        step = 10.0 ** np.floor(np.log10(half))
        nearest = np.round(centre / step) * step
        centre = nearest if np.isfinite(nearest).all() else centre
    return centre, (xyz - centre).astype(np.float32)


def _logit(opacities: npt.NDArray[np.floating[Any]]) -> Array:
    o = opacities.astype(np.float64)
    with np.errstate(divide="ignore"):
        logit = np.log(o) - np.log1p(-o)
    return np.where(o == 0, LOGIT_OF_ZERO, np.where(o == 1, LOGIT_OF_ONE, logit))
