"""Drift of edits against 1,000 drifts that are known, and what of it can be told.

    python -m benchmarks.drift --out reports/drift

A formula's pictures are evaluated at moved coordinates, and changed in colour, blur, noise and by a
repainted part. Views of drawn scenes are rendered anew, after a true edit, by a moved camera.
"""

from __future__ import annotations

import argparse
import json
import lzma
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from attnwarp.camera import Camera
from attnwarp.drift import drift
from benchmarks import command

NAMES = ("shift right, px", "shift down, px", "scale, %", "turn, degrees")
RENDERED = 256
"""Side in px of the rendered views."""

TESTED = (1, 10_001)
"""Seeds of the scenes, and of the first formula; the interval's factors were set on others."""


class Formula:
    """Sum of plane waves through tanh: smooth parts and edges, known at any coordinate."""

    def __init__(self, seed: int) -> None:
        draw = np.random.default_rng(seed)
        length = 10 * 12 ** draw.random(20)  # px
        turn = 2 * np.pi * draw.random(20)
        self.waves = 2 * np.pi / length * np.stack([np.cos(turn), np.sin(turn)])
        self.phases = 2 * np.pi * draw.random(20)
        self.sizes = draw.normal(size=(20, 3)) * np.sqrt(length)[:, None] / 8

    def picture(
        self, size: int, motion: Sequence[float] = (0, 0, 0, 0), stretch: np.ndarray | None = None
    ) -> np.ndarray:
        """(size, size, 3) in [0, 1] at the pixels' centres.

        Args:
            stretch: (2, 2) map about the middle, before the motion.
        """
        right, down, percent, degrees = motion
        at = np.arange(size) + 0.5 - size / 2
        x, y = np.meshgrid(at - right, at - down)
        turn, scale = np.radians(degrees), 1 + percent / 100
        back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) / scale
        points = np.stack([x.ravel(), y.ravel()], -1) @ back.T
        if stretch is not None:
            points = points @ np.linalg.inv(stretch).T
        values = np.tanh(np.sin(points @ self.waves + self.phases) @ self.sizes) / 2 + 0.5
        return values.reshape(size, size, 3)


@dataclass(frozen=True)
class Try:
    """A known drift, and what is measured.

    Attributes:
        number: seed of the try.
        motion: right, down in px, scale in percent, turn in degrees.
        errors, half_widths: four errors and half widths; None if the drift isn't told.
    """

    number: int
    motion: list[float]
    errors: list[float] | None = None
    half_widths: list[float] | None = None


def drawn_motion(draw: np.random.Generator, size: int) -> np.ndarray:
    """Right, down in px at 256 px of the side, scale in percent, turn in degrees."""
    sign = draw.choice([-1, 1], 4)
    shift = draw.choice([0.1, 0.5, 2, 6, 20]) * size / 256 * np.array([draw.random(), 1])
    return np.asarray(sign * [*shift, draw.choice([0, 0.1, 1, 5, 20]), draw.choice([0, 0.1, 1, 5])])


def measured(
    number: int, motion: np.ndarray, before: np.ndarray, after: np.ndarray, left: np.ndarray
) -> Try:
    """Measure the drift of pictures in 8 bits."""
    one, two = (np.clip(255 * p + 0.5, 0, 255).astype(np.uint8) for p in (before, after))
    got = drift(one, two, left)
    known = [float(value) for value in motion]
    if got is None:
        return Try(number, known)
    found = [got.right, got.down, got.scale, got.turn]
    errors, half = found - motion, got.half_widths
    return Try(number, known, [round(float(v), 5) for v in errors], [round(v, 5) for v in half])


def of_formula(number: int, size: int = 256) -> Try:
    """Draw a drift and an edit of a formula's picture."""
    draw = np.random.default_rng(number)
    formula = Formula(number)
    motion = drawn_motion(draw, size)
    before, after = formula.picture(size), formula.picture(size, tuple(motion))
    left = np.ones((size, size), bool)
    if draw.random() < 0.5:  # the edited thing, which counts nowhere
        y, x = draw.integers(0, size // 2, 2)
        left[y : y + size // 3, x : x + size // 3] = False
    if draw.random() < 0.4:  # repainted where the mask says that nothing changes
        y, x = draw.integers(0, size // 2, 2)
        other = Formula(number + 100_000).picture(size)
        after[y : y + size // 3, x : x + size // 2] = other[: size // 3, : size // 2]
    if draw.random() < 0.5:
        mixed = after @ (np.eye(3) + 0.15 * draw.normal(size=(3, 3)))
        after = np.clip(mixed, 0, 1) ** draw.uniform(0.6, 1.6) * draw.uniform(0.6, 1)
    if draw.random() < 0.4:
        after = cv2.GaussianBlur(after, (0, 0), draw.uniform(0.5, 2))
    after = after + draw.normal(size=after.shape) * draw.choice([0, 0.02, 0.06])
    return measured(number, motion, before, after, left)


def moved(camera: Camera, motion: Sequence[float]) -> Camera:
    """The camera that sees everything shifted, larger and turned about the picture's middle.

    Args:
        camera: camera whose principal point is the middle.
        motion: right, down in px, scale in percent, turn in degrees clockwise.
    """
    right, down, percent, degrees = motion
    K, pose = camera.K.copy(), camera.world_to_camera.copy()
    K[:2, :2] *= 1 + percent / 100
    K[:2, 2] += [right, down]
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose[:3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ pose[:3]
    return replace(camera, K=K, world_to_camera=pose, name=f"{camera.name} moved")


def of_scenes(count: int, seed: int) -> Iterator[Try]:
    """Tries with true edits of drawn scenes, five drifts a scene."""
    from attnwarp.process import cache_dir
    from attnwarp_eval.colors import to_srgb
    from attnwarp_eval.drawn.files import write
    from attnwarp_eval.drawn.population import population
    from attnwarp_eval.scene.file import load_scene
    from attnwarp_eval.truth import Geometry, appearance
    from attnwarp_eval.truth.edits import edit_mask

    each = 5
    drawn = population({"drawn": -(-count // each), "seed": seed}).scenes()
    for place, one in enumerate(drawn):
        scene = load_scene(write(one, cache_dir() / "drift")).with_size(RENDERED, RENDERED)
        edit = next(e for e in scene.edits if e.answers and e.lights is None)
        answer = edit.answers[place % len(edit.answers)].name
        edited, source = scene.edited(edit.name, answer), scene.source
        before = to_srgb(np.clip(appearance(scene, source, spp=16, seed=0), 0, 1))
        thing = edit_mask(scene, edit.name, Geometry(scene).trace(source), answer)
        left = ~cv2.dilate(thing.astype(np.uint8), np.ones((5, 5))).astype(bool)
        for number in range(each * place, min(count, each * (place + 1))):
            draw = np.random.default_rng(number)
            motion = drawn_motion(draw, RENDERED)
            light = appearance(edited, moved(source, tuple(motion)), spp=16, seed=1)
            yield measured(number, motion, before, to_srgb(np.clip(light, 0, 1)), left)


def row(name: str, tries: Sequence[Try]) -> list[str]:
    """Cells of a table: tries, told, median and largest errors, misses of the intervals."""
    told = [one for one in tries if one.errors is not None]
    errors = np.abs(np.array([one.errors for one in told], float)).reshape(-1, 4)
    half = np.array([one.half_widths for one in told]).reshape(-1, 4)
    middle = np.median(errors, axis=0)
    missed = errors > half
    return [
        name, f"{len(tries)}", f"{100 * len(told) / len(tries):.1f} %",
        *(f"{value:.3f}" for value in middle),
        f"{np.median(half, axis=0)[1]:.2f}", f"{100 * missed.mean():.2f} %",
        f"{100 * missed.any(axis=1).mean():.1f} %", f"{(errors / half).max():.2f}",
    ]  # fmt: skip


def report(sets: dict[str, list[Try]]) -> str:
    """Write the page."""
    columns = [
        "pictures", "tries", "told", "right, px", "down, px", "scale, %", "turn, degrees",
        "half width, px", "values outside 99 %", "tries with one outside", "farthest",
    ]  # fmt: skip
    lines = [
        "# How exactly is an edit's drift measured?", "",
        "Known drifts: 0.1 to 20 px at 256 px, 0 to 20 %, 0 to 5 degrees, drawn together. Half of"
        " the formula's edits mask a thing, 40 % repaint a sixth of the picture that the mask"
        " leaves, half change colours, 40 % are blurred (0.5 to 2 px), two thirds are noisy (0.02"
        " or 0.06 of white). Rendered ones are true edits of drawn scenes, rendered anew by a"
        " camera that is moved, so no resampling is the estimator's own.", "",
        "Errors are medians of absolute values. An interval misses where the error exceeds its"
        " 99 % half width; *farthest* is the largest error in half widths. Not told: too little"
        " is textured, or too few tiles share one motion.", "",
        "|" + "|".join(f" {c} " for c in columns) + "|", "|" + "---|" * len(columns),
    ]  # fmt: skip
    lines += ["| " + " | ".join(row(name, tries)) + " |" for name, tries in sets.items()]
    first = next(iter(sets))
    lines += ["", f"## By size of the drift, {first}", ""]
    lines += ["| drift | tries | told | " + " | ".join(NAMES) + " |", "|" + "---|" * 7]
    kinds = (
        ("px down", 1, (0.1, 0.5, 2, 6, 20)), ("% of scale", 2, (0, 0.1, 1, 5, 20)),
        ("degrees", 3, (0, 0.1, 1, 5)),
    )  # fmt: skip
    for kind, place, sizes in kinds:
        for size in sizes:
            some = [one for one in sets[first] if abs(abs(one.motion[place]) - size) < 1e-9]
            if some:
                lines.append("| " + " | ".join(row(f"{size:g} {kind}", some)[:7]) + " |")
    lines += [
        "", "The raw results are `tries.jsonl.xz`, one try a line. Made by `python -m"
        " benchmarks.drift --out reports/drift`.",
    ]  # fmt: skip
    return "\n".join(lines)


def read(path: Path) -> dict[str, list[Try]]:
    """Read raw results: tries by the name of their set."""
    sets: dict[str, list[Try]] = {}
    for line in lzma.decompress(path.read_bytes()).decode().splitlines():
        data = json.loads(line)
        sets.setdefault(data.pop("of"), []).append(Try(**data))
    return sets


def main(arguments: Sequence[str] | None = None) -> None:
    """Try known drifts, and write page and raw results."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.drift", description="Measure known drifts of edits."
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of page and results")
    parser.add_argument("--tries", type=int, default=1000, help="of the formula (default 1000)")
    given = parser.parse_args(arguments)
    scenes, first = TESTED
    few = max(1, given.tries // 10)
    sets = {
        "formula, 256 px": [of_formula(first + k) for k in range(given.tries)],
        "formula, 64 px": [of_formula(first + k, 64) for k in range(given.tries)],
        "rendered, 256 px": list(of_scenes(few, scenes)),
    }
    given.out.mkdir(parents=True, exist_ok=True)
    with lzma.open(given.out / "tries.jsonl.xz", "wt") as file:
        for name, tries in sets.items():
            for one in tries:
                file.write(json.dumps({"of": name, **asdict(one)}, sort_keys=True) + "\n")
    command.write_text(given.out / "report.md", report(sets))


if __name__ == "__main__":
    main()
