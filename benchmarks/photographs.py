"""Fits of photographs: largest splat, distortion, held-out PSNR, pixels beyond the scene.

    python -m benchmarks.photographs --draw data/sky --seed 1
    python -m benchmarks.photographs --draw data/yard --seed 1 --above
    python -m benchmarks.photographs --out reports/photographs NAME=FIT=DATA ...

The first writes a drawn scene under clouds, which no first point describes, with its true depth;
the second one from above, without points at its edge. The third measures folders of ``attnwarp
fit`` on the data they were fitted to, with a ``tracks.json`` of ``attnwarp-eval tracks`` there, if
any; fits that differ in the seed alone have one NAME. Fits ``NAME, before`` and ``NAME`` are
compared by seed and view.
"""

from __future__ import annotations

import json
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attnwarp.camera import Camera, up_of
from attnwarp.fit import FitSettings
from attnwarp.fit.loop import choosing
from attnwarp.io import read_dataset, read_image, read_ply
from attnwarp.io.names import file_stems
from attnwarp.render import render
from benchmarks import command

VIEWS, ABOVE, SIZE, POINTS = 40, 17, 192, 4000

NEAR = 0.5
"""First points of a scene seen from above lie within so many camera distances of its middle:
structure from motion finds few on lawn and paving around it."""

OPAQUE = 0.5
"""Alpha below which a pixel shows what is beyond the scene."""


def clouds(directions: np.ndarray, seed: int) -> np.ndarray:
    """(P, 3) sRGB of a sky: two colours mixed by waves of 30 to 5 degrees."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(16, 3)) * np.exp(rng.uniform(np.log(2), np.log(12), (16, 1)))
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    mixed = np.cos(unit @ waves.T + rng.uniform(0, 2 * np.pi, 16)).sum(1) / np.sqrt(16)
    share = 1 / (1 + np.exp(-1.5 * mixed))[:, None]
    return np.asarray(share * [0.93, 0.94, 0.96] + (1 - share) * [0.35, 0.55, 0.85])


def draw(folder: Path, seed: int, file: Path | None, above: bool, size: int) -> None:
    """Write a scene's photographs and their true depth: under clouds, from lower down than its own
    cameras, or from above; ``seed`` draws the scene unless a ``file`` describes one.
    """
    from attnwarp.io import Dataset, write_transforms
    from attnwarp_eval.drawn.files import write
    from attnwarp_eval.drawn.population import population
    from attnwarp_eval.files import write_picture
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.splats.export import first_points, orbit, picture
    from attnwarp_eval.truth import Geometry

    if file is None:
        (drawn,) = population({"drawn": 1, "seed": seed}).scenes()
        file = write(drawn, folder)
    scene = load_scene(file)
    geometry = Geometry(scene)
    cloud = first_points(scene, POINTS, seed=seed, geometry=geometry)
    radius = scene.spec.cameras.radius
    near = np.linalg.norm(cloud.points - scene.center, axis=1) < (NEAR if above else 3) * radius
    cameras, paths, depths = [], [], {}
    for k, camera in enumerate(orbit(scene, ABOVE if above else VIEWS, size)):
        eye = np.array(camera.position)
        aim = scene.center + np.array([0, 0, 0 if above else 0.2 * radius])
        if above:
            eye[2] = scene.center[2] + (0.9 + 0.1 * (k % 4)) * radius
        else:
            eye[2] = scene.center[2] + 0.3 * (eye[2] - scene.center[2]) + 0.05 * radius
        low = Camera.look_at(
            eye.tolist(), aim.tolist(), width=size, height=size, fov_y=55, name=f"{k:02d}.png"
        )
        image, depth = picture(scene, low, 8), geometry.trace(low).depth
        sky = ~np.isfinite(depth)
        rays = low.directions()[sky] @ low.rotation
        image[sky] = np.round(255 * clouds(rays, seed))
        cameras.append(low)
        paths.append(write_picture(folder / "images" / low.name, image))
        depths[low.name] = np.where(sky, np.inf, depth)
    data = Dataset(cameras, list(paths), cloud.points[near], cloud.colors[near])
    write_transforms(folder, data, points_name="points.ply")
    np.savez_compressed(folder / "depth.npz", allow_pickle=True, **depths)


def measure(fit: Path, data: Path) -> dict[str, Any]:
    """Figures of one fit, by held-out view where a view has some."""
    settings = json.loads((fit / "settings.json").read_text())
    splats, dataset = read_ply(fit / "splats.ply"), read_dataset(data)
    extent, near = settings["extent"], settings["near"] * settings["extent"]
    middle = np.stack([camera.position for camera in dataset.cameras]).mean(0)
    away = torch.from_numpy(splats.world_means() - middle)
    far = away.norm(dim=1) > splats.far
    scene, sky = splats.select(~far), replace(splats, far=np.inf).select(far)
    depths = np.load(data / "depth.npz") if (data / "depth.npz").is_file() else {}
    history = [json.loads(line) for line in (fit / "history.jsonl").read_text().splitlines()]
    stems = file_stems(dataset.cameras)
    views: dict[str, dict[str, Any]] = {}
    for path in sorted((fit / "held_out").glob("*.png")):
        pair = read_image(path)[..., :3].astype(np.float64) / 255
        height, width = pair.shape[0], pair.shape[1] // 2
        error = float(np.square(pair[:, :width] - pair[:, width:]).mean())
        camera = dataset.cameras[stems.index(path.stem)]
        view = render(splats, camera.resize(width, height), near=near)
        alpha = view.alpha.numpy()
        views[path.stem] = {
            "psnr": -10 * float(np.log10(error)),
            "beyond": float((alpha < OPAQUE).mean()),
            "distortion": float(view.distortion_ordered.min()),
        }
        if path.name in depths:
            behind = render(sky, camera.resize(width, height), near=near).alpha.numpy()
            views[path.stem] |= against(view, behind, depths[path.name])
    return {
        "seed": settings["seed"],
        "iterations": history[-1]["iteration"],
        "stopped": settings["stopped"],
        "splats": len(splats),
        "sky_splats": len(sky),
        "below_horizon": below(away[far], dataset.cameras),
        "largest": float(scene.scales.max()) / extent,
        "cpu_seconds": history[-1]["cpu_seconds"],
        "chose": chose(settings, [stem for stem in stems if stem in views]),
        "tracks": tracks(fit / "tracks.json"),
        "views": views,
    }


def tracks(path: Path) -> float | None:
    """Median distance in px of warps from the tracks of structure from motion, if measured."""
    if not path.is_file():
        return None
    (row,) = (row for row in json.loads(path.read_text())["rows"] if row["views"] == "all")
    return float(row["figures"]["median"]["value"])


def below(away: torch.Tensor, cameras: list[Camera]) -> int:
    """Number of sky splats, by their offsets from the cameras' mean, below the horizon."""
    return int((away @ torch.from_numpy(up_of(cameras)[0]) < 0).sum())


def chose(settings: dict[str, Any], held_out: list[str]) -> list[str]:
    """Names of the held-out views that chose the splats: every second one at first, then by
    :func:`attnwarp.fit.loop.choosing`; either counts.
    """
    rule = choosing(len(held_out), FitSettings(patience=settings["patience"]))
    return [
        name
        for k, name in enumerate(held_out)
        if settings["patience"] is not None and (k % 2 or k in rule)
    ]


def against(view: Any, behind: np.ndarray, depth: np.ndarray) -> dict[str, float | None]:
    """Errors of a render at a view's true depth, infinite in the sky; ``behind``: its splats' alpha
    alone.
    """
    solid, alpha = np.isfinite(depth), view.alpha.numpy()
    error = np.abs(view.depth.double().numpy()[solid] / depth[solid] - 1)
    shown = alpha[solid] >= OPAQUE
    return {
        "depth_error": float(np.median(error[shown])),
        "depth_wrong": float((error[shown] > 0.1).mean()),
        "surface_lost": float(1 - shown.mean()),
        "sky_with_depth": float((alpha[~solid] >= OPAQUE).mean()) if (~solid).any() else 0.0,
        "sky_covered": float((behind[~solid] >= OPAQUE).mean()) if (~solid).any() else None,
    }


def row(name: str, fits: list[dict[str, Any]], apart: set[str]) -> str:
    """A line of the table; ``apart``: views that choose in some fit of these data."""

    def each(figure: str, of: Any) -> list[float]:
        return [
            of([v[figure] for stem, v in fit["views"].items() if stem not in apart])
            for fit in fits
        ]  # fmt: skip

    def span(values: list[float]) -> str:
        return f"{statistics.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})"

    cells = [
        name,
        ", ".join(str(fit["seed"]) for fit in fits),
        f"{statistics.mean(fit['splats'] for fit in fits):,.0f}",
        f"{statistics.mean(fit['cpu_seconds'] for fit in fits):.0f} s",
        f"{max(fit['largest'] for fit in fits):.2g}",
        f"{min(each('distortion', min)):.1g}",
        span(each("psnr", statistics.mean)),
        span(each("psnr", statistics.median)),
        span(each("psnr", min)),
        f"{100 * statistics.mean(each('beyond', statistics.mean)):.1f} %",
    ]
    return "| " + " | ".join(cells) + " |"


def rightly(view: dict[str, float]) -> float:
    """Share of a view's surface with a depth within 10 %."""
    return (1 - view["depth_wrong"]) * (1 - view["surface_lost"])


def depth_row(name: str, fits: list[dict[str, Any]]) -> str:
    """A line of the table of scenes whose depth is known."""
    figures = ("depth_error", "depth_wrong", "surface_lost", "sky_with_depth", "sky_covered")
    views = [view for fit in fits for view in fit["views"].values()]
    known = [[view[figure] for view in views if view[figure] is not None] for figure in figures]
    known.append([rightly(view) for view in views])
    cells = [f"{100 * statistics.mean(values):.1f} %" if values else "" for values in known]
    return "| " + " | ".join([name, *cells]) + " |"


def report(results: dict[str, list[dict[str, Any]]]) -> str:
    """Text of the report."""
    lines = [
        "| fit | seeds | splats | CPU | largest | distortion | held out, mean, dB |"
        " median view, dB | worst view, dB | beyond |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, fits in results.items():
        capture = name.split(",")[0]
        near = [f for other, fs in results.items() if other.split(",")[0] == capture for f in fs]
        lines.append(row(name, fits, {stem for fit in near for stem in fit["chose"]}))
    known = {
        name: fits
        for name, fits in results.items()
        if "depth_error" in next(iter(fits[0]["views"].values()))
    }
    if known:
        lines += [
            "",
            "Against the true depth: the median relative error and the share off by more than 10 %,"
            " both where alpha is at least 0.5; surface where it is less; sky where it is not, and"
            " where the sky's splats alone are opaque; surface with a depth within 10 %.",
            "",
            "| fit | median error | off by 10 % | surface without depth | sky with depth |"
            " sky covered | surface right |",
            "|---|---|---|---|---|---|---|",
            *(depth_row(name, fits) for name, fits in known.items()),
        ]
    lines += [
        "",
        "After less before, paired by seed and held-out view that chooses in neither: mean (least"
        " and largest seed). Distance from tracks and CPU: after over before."
        " Low: below the horizon.",
        "",
        "| capture | PSNR, dB | surface right, points | tracks | CPU | sky splats (low), before |"
        " after |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        compared(name, results[f"{name}, before"], fits)
        for name, fits in results.items()
        if f"{name}, before" in results
    ]
    return "\n".join(lines)


def compared(name: str, before: list[dict[str, Any]], after: list[dict[str, Any]]) -> str:
    """A line of the table of differences between fits of one capture."""
    gains, errors, costs, strays = [], [], [], []
    for old, new in zip(before, after, strict=True):
        assert old["seed"] == new["seed"] and old["iterations"] == new["iterations"]
        kept = [stem for stem in new["views"] if stem not in {*old["chose"], *new["chose"]}]
        pairs = [(old["views"][stem], new["views"][stem]) for stem in kept]
        gains.append(statistics.mean(b["psnr"] - a["psnr"] for a, b in pairs))
        costs.append(new["cpu_seconds"] / old["cpu_seconds"])
        if new["tracks"] is not None:
            strays.append(new["tracks"] / old["tracks"])
        if "depth_error" in pairs[0][0]:
            right = [statistics.mean(map(rightly, fit["views"].values())) for fit in (old, new)]
            errors.append(100 * (right[1] - right[0]))
    cells = [name] + [
        f"{statistics.mean(values):{form}} ({min(values):{form}} to {max(values):{form}})"
        if values
        else ""
        for values, form in ((gains, "+.2f"), (errors, "+.1f"), (strays, ".2f"), (costs, ".2f"))
    ]
    for fits in (before, after):
        low = sum(fit["below_horizon"] for fit in fits)
        cells.append(f"{sum(fit['sky_splats'] for fit in fits):,} ({low:,})")
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Run the command line."""
    parser = command.parser("photographs", "Draw a scene under clouds, or measure fits.")
    parser.add_argument("--draw", type=Path, help="write a drawn scene under clouds here")
    parser.add_argument("--seed", type=int, default=0, help="seed of the drawn scene")
    parser.add_argument("--scene", type=Path, help="draw this scene file instead")
    parser.add_argument("--above", action="store_true", help="draw 17 views from above")
    parser.add_argument("--size", type=int, default=SIZE, help="side of a drawn picture in px")
    parser.add_argument("fits", nargs="*", metavar="NAME=FIT=DATA", help="folders to measure")
    options = parser.parse_args()
    if options.draw:
        draw(options.draw, options.seed, options.scene, options.above, options.size)
        return
    results: dict[str, list[dict[str, Any]]] = {}
    for text in options.fits:
        name, fit, data = text.split("=")
        results.setdefault(name, []).append(measure(Path(fit), Path(data)))
        print(row(name, results[name][-1:], set(results[name][-1]["chose"])), flush=True)
    table = report(results)
    if options.out is None:
        print(table)
        return
    command.write_figures(options.out / "results.json", results)
    path = options.out / "README.md"
    before, _, after = path.read_text().split("<!-- table -->")
    command.write_text(path, f"{before}<!-- table -->\n{table}\n<!-- table -->{after}".rstrip())


if __name__ == "__main__":
    main()
