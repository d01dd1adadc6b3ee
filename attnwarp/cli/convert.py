"""attnwarp convert and attnwarp undistort: files for other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from attnwarp.cli.files import read_splats, read_views
from attnwarp.cli.options import (
    AntialiasedOption,
    Coordinates,
    DataArgument,
    Reading,
    ScreenFilterOption,
    SplatKindOption,
    options_of,
)
from attnwarp.cli.shell import check_out, clear_errors
from attnwarp.reporting import reporter

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from attnwarp.gaussians import Gaussians

FORMATS = (".ply", ".splat", ".spz", ".glb")

AROUND = 8
"""Views from which the round trip through another format is measured."""


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Splats: .ply or .splat.")],
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="File to write: .ply, .splat, .spz or .glb.")
    ],
    kind: SplatKindOption = None,
    antialiased: AntialiasedOption = None,
    screen_filter: ScreenFilterOption = None,
    third_scale: Annotated[
        float | None,
        typer.Option(help="Write 2DGS as thin 3DGS with this third scale (1e-6)."),
    ] = None,
    sh_degree: Annotated[
        int | None, typer.Option(min=0, max=3, help="Cut harmonics beyond this degree.")
    ] = None,
    coordinates: Annotated[
        Coordinates,
        typer.Option(
            help="world, relative to the origin comment that attnwarp alone reads, or auto: world"
            " unless float32 would lose too much."
        ),
    ] = Coordinates.auto,
) -> None:
    """Convert splats for other programs: 2DGS as thin 3DGS, .splat, fewer harmonics, no origin.

    SPZ and glTF are written by splat-transform; how much they change is measured and said.
    """
    with clear_errors():
        suffix = out.suffix.lower()
        if suffix not in FORMATS:
            raise ValueError(f"OUT: got {out}, expected a name ending in {', '.join(FORMATS)}")
        _check_start(source)
        from attnwarp.io import THIRD_SCALE, write_ply, write_splat
        from attnwarp.io.file import check_other

        check_other(out, source, "the file to convert")
        splats = read_splats(source, kind, antialiased, screen_filter)
        if third_scale is not None and splats.kind == "3d":
            raise ValueError(f"--third-scale: {source} holds 3DGS, which has three scales")
        if sh_degree is not None:
            splats = splats.with_sh_degree(min(sh_degree, splats.sh_degree))
        if suffix == ".splat":
            write_splat(
                out,
                splats,
                third_scale=THIRD_SCALE if third_scale is None else third_scale,
                coordinates="relative" if coordinates == "relative" else "world",
            )
        elif suffix == ".ply":
            write_ply(out, splats, third_scale=third_scale, coordinates=coordinates.value)
        else:
            third = third_scale or (THIRD_SCALE if splats.kind == "2d" else None)
            typer.echo(_by_splat_transform(out, splats, third, coordinates.value))
            return
        typer.echo(f"{out}: {len(splats)} splats")


def _by_splat_transform(
    out: Path, splats: Gaussians, third_scale: float | None, coordinates: str
) -> str:
    """Write SPZ or glTF; return a line on what its round trip changes in renders."""
    from tempfile import TemporaryDirectory

    from attnwarp.io import read_ply, write_ply
    from attnwarp.io.splat_transform import read_back, transform

    with TemporaryDirectory() as place:
        ply = Path(place) / "splats.ply"
        write_ply(ply, splats, third_scale=third_scale, coordinates=cast(Any, coordinates))
        transform(ply, out)
        before = read_ply(ply, kind="3d", antialiased=splats.antialiased)
    after, turn = read_back(out)
    psnr = _psnr_around(before, after, turn)
    met = f"{psnr:.1f} dB" if math.isfinite(psnr) else "equal pictures"
    size = out.stat().st_size / 2**20
    return (
        f"{out}: {len(splats)} splats, {size:.1f} MiB; written and read again they render with"
        f" {met} (PSNR over {AROUND} views around them)"
    )


def _psnr_around(before: Gaussians, after: Gaussians, turn: npt.NDArray[np.float64]) -> float:
    """PSNR of renders of two models, pooled over views around them.

    Args:
        before, after: the models; ``after`` in a frame of its own.
        turn: (4, 4) from the frame of ``before`` to that of ``after``.
    """
    from dataclasses import replace

    import numpy as np

    from attnwarp.camera import Camera
    from attnwarp.losses import psnr_of_mse
    from attnwarp.render import render

    points = before.world_means()
    middle = np.median(points, axis=0)
    reach = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.75)) or 1.0
    after, errors = replace(after, antialiased=before.antialiased), []
    for angle in 2 * np.pi * np.arange(AROUND) / AROUND:
        place = middle + 2.5 * reach * np.array([np.cos(angle), np.sin(angle), 0.3])
        camera = Camera.look_at(tuple(place), tuple(middle), width=256, height=256, fov_y=50)
        pose = camera.world_to_camera @ np.linalg.inv(turn)
        turned = replace(camera, world_to_camera=pose)
        one = render(before, camera, near=0.01 * reach).color.clamp(0, 1)
        two = render(after, turned, near=0.01 * reach).color.clamp(0, 1)
        errors.append(float((one - two).double().square().mean()))
    return psnr_of_mse(sum(errors) / len(errors))


def _check_start(path: Path) -> None:
    """Refuse what does not begin as a PLY does, before the seconds of torch's import."""
    if path.suffix.lower() == ".splat" or not path.is_file():
        return
    with path.open("rb") as stream:
        if stream.read(3) != b"ply":
            raise ValueError(
                f"{path}: not a PLY file, which begins with 'ply'; expected splats, .ply or .splat"
            )


@options_of(Reading)
def undistort(
    data: DataArgument,
    out: Annotated[Path, typer.Argument(help="Folder for transforms.json and images/.")],
    *,
    reading: Reading,
) -> None:
    """Resample pictures to pinhole cameras, for lens models that OpenCV has."""
    with clear_errors(f"stopped; the pictures in {out} are whole, and the same command makes all"):
        check_out(out)
        import attnwarp.io
        from attnwarp.io.file import check_other

        check_other(out, data if data.is_dir() else data.parent, "the folder to undistort")
        dataset = read_views(data, reading, distorted="keep")
        count = sum(lens is not None for lens in dataset.lenses)
        with reporter(title=out.name) as report:
            result = attnwarp.io.undistort(dataset, out, report=report)
        typer.echo(f"{out}: {len(result)} pictures, {count} of them undistorted")
