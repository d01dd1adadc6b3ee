"""Commands attnwarp convert and attnwarp undistort: files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from attnwarp.cli.files import read_splats, read_views
from attnwarp.cli.options import (
    AntialiasedOption,
    DataArgument,
    Reading,
    ScreenFilterOption,
    SplatKindOption,
    option,
    options_of,
)
from attnwarp.cli.shell import check_out, clear_errors
from attnwarp.reporting import reporter

FORMATS = (".ply", ".splat")


def convert(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IN", help="Splats to convert: a .ply, .splat, .spz, .sog or .ksplat file."
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write, .ply or .splat.")],
    kind: SplatKindOption = None,
    antialiased: AntialiasedOption = None,
    screen_filter: ScreenFilterOption = None,
    third_scale: Annotated[
        float | None,
        option(
            "Write 2DGS as thin 3DGS with this third scale in scene units (.splat: default 1e-6;"
            " .ply: default 2DGS as it is).",
            "SCALE",
        ),
    ] = None,
    sh_degree: Annotated[
        int | None,
        option("Cut harmonics beyond this degree, 0 to 3 (default: keep all).", "N", min=0, max=3),
    ] = None,
    coordinates: Annotated[
        Literal["auto", "world", "relative"],
        option(
            "Write positions in world coordinates (world), relative to an origin in the file's"
            " header that attnwarp alone reads (relative), or auto: world unless float32 would lose"
            " too much."
        ),
    ] = "auto",
) -> None:
    """Convert splats for other programs: 2DGS as thin 3DGS, as .splat, with fewer
    harmonics or in world coordinates.
    """
    with clear_errors():
        suffix = out.suffix.lower()
        if suffix not in FORMATS:
            raise ValueError(f"OUT: got {out}, expected a name ending in {', '.join(FORMATS)}")
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
        else:
            write_ply(out, splats, third_scale=third_scale, coordinates=coordinates)
        typer.echo(f"{out}: {len(splats)} splats")


@options_of(Reading)
def undistort(
    data: DataArgument,
    out: Annotated[Path, typer.Argument(help="Folder to write transforms.json and images/ to.")],
    *,
    reading: Reading,
) -> None:
    """Resample pictures of distorted cameras as pinhole cameras would see them."""
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
