"""Distance of float32 from the renderer's definition where scales are mixed: ``python -m
benchmarks.precision``.

Pictures of 40 x 30 pixels, focal length 40 px, of 24 splats three units away. Each scale is drawn
log-uniform about 1 over a ratio, so that needles and sheets meet in one picture. An error is the
distance to what the float64 reference may give when its thresholds move by their rounding, as a
share of the value where that is above 1. The table has the worst of all pixels, outputs and
pictures, and how many pictures are off by more than 1e-4.

Before it stands a table of single 2D needles: the error of their alpha against their width in the
picture, which is what the error depends on.

The last column is the part of the 2D error that conditioning does not explain: the definition is
also rendered with each splat moved by what float32 may round of a pixel's position,
:data:`ROUNDED_PIXELS`. What no such move gives is the renderer's own.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render import api, constants, cpu, reference
from attnwarp.render.interface import OUTPUTS, Inputs
from benchmarks import command

MODES = [
    ("2d", "intersection", False),
    ("2d", "center", False),
    ("3d", "center", False),
    ("3d", "peak", True),
]
"""Kind, depth, antialiased."""

RATIOS = (1e0, 1e2, 1e3, 1e4, 1e6, 1e8, 1e10, 1e12)

WIDTHS = (1.0, 0.1, 0.03, 0.01, 0.003, 0.001)
"""Widths of needles, px."""

LIMIT = 1e-4

ROUNDED_PIXELS = 21 * 2.0**-24
"""Distance by which float32 moves a splat in the picture, px.

A splat's u at a pixel is u_0 + u_x x + u_y y in float32, with (x, y) within 3.5 px of the middle of
8 x 8 pixels. Three coefficients, two products and two sums are rounded, of numbers up to |u_x x| +
|u_y y|, as u itself is about 1 where the splat is drawn: at most 6 x 2^-24 of that, 6 x 3.5 x 2^-24
px.
"""


def prepared(splats: Gaussians, camera: Camera, **options: object) -> Inputs:
    """Inputs of a backend, with the defaults of `render`."""
    given = dict.fromkeys(("depth", "background", "features", "sh_degree", "antialiased", "pose"))
    given |= {"near": constants.NEAR, "ndc": (constants.NDC_NEAR, constants.NDC_FAR)}
    return api._prepare(splats, camera, **(given | options), on_cpu=True)  # type: ignore[arg-type]


def mixed_scales(splats: Gaussians, seed: int, ratio: float) -> Gaussians:
    """The splats with each scale drawn anew, log-uniform about 1 over a ``ratio``; in float32, as
    files have them."""
    rng = np.random.default_rng(seed)
    reach = math.log(ratio) / 2
    scales = torch.tensor(np.exp(rng.uniform(-reach, reach, splats.scales.shape)))
    return dataclasses.replace(splats, scales=scales).to(dtype=torch.float32)


def displaced(inputs: Inputs, seed: int) -> Inputs:
    """Each splat moved across the picture by :data:`ROUNDED_PIXELS` in x and in y, to a random
    side."""
    rng = np.random.default_rng(seed)
    means, pose = inputs.means.double(), inputs.pose.detach().double()
    rotation = pose[:3, :3]
    depth = (means @ rotation.T + rotation @ inputs.origin.double() + pose[:3, 3])[:, 2].abs()
    signs = torch.tensor(rng.choice((-1.0, 1.0), (len(means), 2)))
    focal = torch.stack([inputs.K[0, 0], inputs.K[1, 1]]).double()
    step = ROUNDED_PIXELS * signs * depth[:, None] / focal
    return dataclasses.replace(inputs, means=means + step @ rotation[:2])


def bracket(inputs: Inputs, displacements: int = 0) -> dict[str, tuple[Tensor, Tensor]]:
    """Smallest and largest value of each output when every threshold is moved by what float32 may
    round.

    A pixel whose alpha is 1/255 to seven digits is drawn or not by rounding, in any renderer; what
    must hold is that the float32 answer is one of the two.

    Args:
        inputs: the scene.
        displacements: how many times the splats are moved, see :func:`displaced`.
    """
    t = reference.Thresholds()
    versions = [reference.render(inputs)]
    for sign in (-1, 1):
        versions += [
            reference.render(
                inputs, dataclasses.replace(t, alpha_min=t.alpha_min * (1 + sign * 2e-6))
            ),
            # Transmittance is a product of up to 40 factors, each with its own rounding.
            reference.render(inputs, dataclasses.replace(t, stop=t.stop * (1 + sign * 2e-5))),
            reference.render(inputs, dataclasses.replace(t, median=t.median * (1 + sign * 5e-6))),
            reference.render(dataclasses.replace(inputs, near=inputs.near * (1 + sign * 2e-6))),
        ]
    versions += [reference.render(displaced(inputs, seed)) for seed in range(displacements)]
    result = {}
    for name in OUTPUTS:
        stack = torch.stack([getattr(v, name) for v in versions])
        absent = stack.isnan()
        low = torch.where(absent, torch.inf, stack).amin(0)
        high = torch.where(absent, -torch.inf, stack).amax(0)
        low = torch.where(absent.any(0), -torch.inf, low)
        high = torch.where(absent.any(0), torch.inf, high)
        # NaN everywhere is an answer as well.
        result[name] = (
            torch.where(absent.all(0), torch.nan, low),
            torch.where(absent.all(0), torch.nan, high),
        )
    return result


def excess(inputs: Inputs, displacements: int = 0, backend: str = "cpu") -> dict[str, float]:
    """Distance by which each output of backend "cpu" or "gpu" lies outside of its bounds.

    Raises:
        AssertionError: an output is NaN where it is defined, or the other way round.
    """
    if backend == "cpu":
        actual = cpu.render(inputs)
    else:
        from attnwarp.render import gpu

        actual = gpu.render(inputs)
    expected = bracket(inputs, displacements)
    worst = {}
    for name in OUTPUTS:
        value, (low, high) = getattr(actual, name).double(), expected[name]
        assert not bool((value.isnan() & torch.isfinite(low)).any()), name
        assert bool(value.isnan()[low.isnan()].all()), name
        # Absolute on shares of a pixel; of the value's own size where it has a scale (depth in
        # scene units, weight in pixels, features of any size).
        beyond = torch.maximum(low - value, value - high) / value.abs().clamp(min=1)
        beyond = beyond[torch.isfinite(beyond)]
        worst[name] = max(0.0, float(beyond.max())) if beyond.numel() else 0.0
    return worst


def scene(seed: int, kind: str, ratio: float) -> tuple[Gaussians, Camera]:
    """Random splats of mixed scales, three units before a camera."""
    rng = np.random.default_rng(seed)
    position = np.array([0.0, -3.0, 0.3]) + rng.uniform(-0.3, 0.3, 3)
    view = Camera.look_at(position.tolist(), (0, 0, 0), width=40, height=30, fov_y=41)
    count, axes = 24, 2 if kind == "2d" else 3
    splats = Gaussians(
        "2d" if kind == "2d" else "3d",
        torch.tensor(0.5 * rng.normal(size=(count, 3))),
        torch.tensor(rng.normal(size=(count, 4))),
        torch.ones(count, axes, dtype=torch.float64),
        torch.tensor(rng.uniform(0.02, 1, size=count)),
        torch.tensor(0.4 * rng.normal(size=(count, 4, 3))),
    )
    return mixed_scales(splats, seed + 1_000_000, ratio), view


def run(ratios: Sequence[float], pictures: int) -> list[dict[str, Any]]:
    """A row for each ratio and mode: the worst error, by output, and of how many pictures."""
    rows = []
    for ratio in ratios:
        for kind, depth, antialiased in MODES:
            worst, own = [], []
            for seed in range(pictures):
                splats, camera = scene(seed, kind, ratio)
                inputs = prepared(
                    splats, camera, depth=depth, antialiased=antialiased if kind == "3d" else None
                )
                worst.append(excess(inputs))
                if kind == "2d":
                    own.append(max(excess(inputs, displacements=8).values()))
            rows.append(
                {
                    "ratio": ratio,
                    "mode": f"{kind} {depth}",
                    "worst": {name: max(w[name] for w in worst) for name in OUTPUTS},
                    "beyond": sum(max(w.values()) > LIMIT for w in worst),
                    "pictures": pictures,
                    "unexplained": max(own) if own else None,
                }
            )
    return rows


def needle(seed: int, width: float) -> tuple[Gaussians, Camera, tuple[int, int]]:
    """A 2D splat that faces the camera, 13 px long and ``width`` px wide (sigmas), such that a
    pixel lies one sigma off its long axis, and that pixel's (row, column)."""
    rng = np.random.default_rng(seed)
    K = np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    angle, place = rng.uniform(0, 2 * np.pi), rng.uniform(3, 10)
    along, across = (
        np.array([np.cos(angle), np.sin(angle)]),
        np.array([-np.sin(angle), np.cos(angle)]),
    )
    column, row = int(rng.integers(10, 30)), int(rng.integers(8, 22))
    center = np.array([column + 0.5, row + 0.5]) - width * across - place * along
    depth = 3.0
    splats = Gaussians(
        "2d",
        torch.tensor([[*(center - K[:2, 2]) * depth / 40, depth]]),
        torch.tensor([[np.cos(angle / 2), 0, 0, np.sin(angle / 2)]]),
        torch.tensor([[1.0, width * depth / 40]], dtype=torch.float64),
        torch.ones(1, dtype=torch.float64),
        torch.zeros(1, 1, 3, dtype=torch.float64),
    ).to(dtype=torch.float32)
    return splats, Camera(K, np.eye(4), 40, 30), (row, column)


def needles(widths: Sequence[float], count: int) -> list[dict[str, float]]:
    """The largest error of alpha one sigma off needles of each width, and what
    :data:`ROUNDED_PIXELS` bounds it by: alpha changes by at most exp(-1/2) / width a pixel."""
    rows = []
    for width in widths:
        worst = 0.0
        for seed in range(count):
            splats, camera, pixel = needle(seed, width)
            inputs = prepared(splats, camera)
            error = cpu.render(inputs).alpha.double() - reference.render(inputs).alpha
            worst = max(worst, float(error[pixel].abs()))
        bound = math.exp(-0.5) * math.sqrt(2) * ROUNDED_PIXELS / width
        rows.append({"width": width, "worst": worst, "bound": bound})
    return rows


def needle_table(rows: Sequence[dict[str, float]]) -> str:
    """The rows for a person, as Markdown."""
    lines = ["| width of a 2D needle, px | worst error of alpha | bound |", "|---|---|---|"]
    lines += [f"| {r['width']:g} | {r['worst']:.1e} | {r['bound']:.1e} |" for r in rows]
    return "\n".join(lines)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows for a person, as Markdown."""
    lines = [
        "| ratio | mode | colour, alpha | normal | depth | distortion | pictures beyond 1e-4"
        " | not by conditioning |",
        "|---|---|---|---|---|---|---|---|",
    ]
    groups = (
        ("color", "alpha", "weight"),
        ("normal",),
        ("depth", "median_depth"),
        ("distortion_l1", "distortion_ordered", "distortion_l2_ndc"),
    )
    for row in rows:
        cells = [f"{row['ratio']:.0e}", row["mode"]]
        cells += [f"{max(row['worst'][name] for name in group):.1e}" for group in groups]
        cells.append(f"{row['beyond']} of {row['pictures']}")
        cells.append("" if row["unexplained"] is None else f"{row['unexplained']:.1e}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser(
        "precision", "Measure the renderer's error against the ratio of scales."
    )
    parser.add_argument("--quick", action="store_true", help="ratios 1 and 1e6, 2 pictures each")
    parser.add_argument("--pictures", type=int, default=12, help="of each ratio and mode (12)")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # small tensors: threads would only wait for each other
    thin = needles(WIDTHS, 20 if options.quick else 200)
    print(needle_table(thin) + "\n")
    rows = run((1e0, 1e6), 2) if options.quick else run(RATIOS, options.pictures)
    print(table(rows))
    command.write_figures(options.out, {"needles": thin, "ratios": rows})


if __name__ == "__main__":
    main()
