"""How good is optical flow in place of exact correspondences, as the field measures consistency?

    python -m attnwarp_eval.flow_study --out runs/flow

For each scene and yaw: the exact disagreement of two views and the one along optical flow, on the edited object, of four
pairs of pictures whose consistency is known beforehand: the unedited truth and an edit with one answer in both views
(both as consistent as the scene itself), the same with the target moved by 2 px, and one with a different answer in each
view (as inconsistent as can be). The table of docs/metrics.md comes from here.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.camera import Camera
from attnwarp_eval.scene import Scene

SCENES = {"bear": "some_colour", "dinosaur": "some_colour", "person": "some_jacket"}
"""Scenes, and an edit of each with several right answers."""

YAWS = (2.0, 5.0, 10.0, 20.0, 30.0, 60.0)

SLIP = 2
"""Pixels by which the target is moved sideways for the pair "slip": an edit whose details are a little out of place."""

PAIRS = ("truth", "one_answer", "slip", "two_answers")
"""What the two views show: the scene unedited; edited with one answer; the same, the target moved by :data:`SLIP`; the
source with one answer, the target with another."""


@dataclass(frozen=True)
class Row:
    """One scene, yaw and flow method; keys are those of :data:`attnwarp_eval.metric.METRICS`.

    Attributes:
        figures: by what the two views show (:data:`PAIRS`), exact figures, flow figures (``flow_``), what separates them
            (``flow_gap_``), and flow figures at the pixels of the exact ones (``flow_same_``).
        flow: the endpoint error of the flow and its check, whole picture.
    """

    scene: str
    yaw: float
    method: str
    figures: dict[str, dict[str, float]]
    flow: dict[str, float]


def turned(scene: Scene, yaw: float) -> Camera:
    """The scene's source camera, taken around the point that it looks at by ``yaw`` degrees, at the same height."""
    spec = scene.spec.cameras
    angle = np.radians(spec.source.yaw + yaw)
    position = (
        spec.look_at[0] + spec.radius * float(np.cos(angle)),
        spec.look_at[1] + spec.radius * float(np.sin(angle)),
        float(scene.source.position[2]),
    )
    return Camera.look_at(
        position, spec.look_at, width=spec.size[0], height=spec.size[1], fov_y=spec.fov, name=f"turned{yaw:g}"
    )


def study(
    name: str,
    edit: str,
    *,
    size: int,
    spp: int,
    yaws: Sequence[float],
    method: Any = "dis",
    keep: Callable[[str, Any], object] | None = None,
) -> Iterator[Row]:
    """The rows of one scene.

    Args:
        name: of the scene, or its path.
        edit: one with at least two answers, which changes objects and not the light.
        size: of the pictures in px.
        spp: samples a pixel.
        yaws: degrees from the source.
        method: of :func:`attnwarp_eval.metrics.optical_flow`.
        keep: given names and (H, W, 3) sRGB pictures to look at.

    Raises:
        ValueError: an edit with one result.
    """
    from attnwarp_eval import metrics
    from attnwarp_eval.edited import edit_mask
    from attnwarp_eval.scene_file import load_scene
    from attnwarp_eval.truth import Geometry, appearance, to_srgb, two_view

    scene = load_scene(name).with_size(size, size)
    answers = [one.name for one in scene.edit(edit).answers]
    if len(answers) < 2:
        raise ValueError(f"edit {edit!r} of {scene.name!r}: got one result, expected at least two answers")
    worlds = {"truth": scene, **{one: scene.edited(edit, one) for one in (answers[0], answers[-1])}}
    geometry = Geometry(scene)

    def picture(world: str, camera: Camera) -> Any:
        return to_srgb(appearance(worlds[world], camera, spp=spp))

    source = {world: picture(world, scene.source) for world in ("truth", answers[0])}
    for yaw in yaws:
        camera = turned(scene, yaw)
        pair = two_view(geometry, scene.source, camera)
        target = {world: picture(world, camera) for world in worlds}
        # One object for all pairs, that of the first answer: answers may change others besides.
        mask = edit_mask(scene, edit, pair.hits, answers[0])
        flow = metrics.optical_flow(source["truth"], target["truth"], method)
        shown = {
            "truth": (source["truth"], target["truth"]),
            "one_answer": (source[answers[0]], target[answers[0]]),
            "slip": (source[answers[0]], np.roll(target[answers[0]], SLIP, axis=1)),
            "two_answers": (source[answers[0]], target[answers[-1]]),
        }
        figures = {}
        for kind, (one, other) in shown.items():
            exact = metrics.cross_view(one, other, pair, mask=mask)
            by_flow = metrics.flow_consistency(one, other, flow, mask=mask)
            same = metrics.flow_consistency(one, other, flow, mask=exact.counted)
            figures[kind] = {
                **exact.figures(),
                **by_flow.figures("flow_"),
                **same.figures("flow_same_"),
                **metrics.approximation_error(exact, by_flow),
            }
            if keep is not None:
                keep(f"{scene.name}-{yaw:g}-{kind}", _sheet(one, other, exact.delta_e, by_flow.delta_e))
        yield Row(scene.name, yaw, method, figures, metrics.flow_error(flow, pair))


def _sheet(source: Any, target: Any, exact: Any, flow: Any) -> Any:
    """Source, target, exact DeltaE and DeltaE along the flow, side by side: black 0, white 40 and beyond, blue not counted."""
    maps = []
    for delta_e in (exact, flow):
        grey = np.repeat(np.clip(np.nan_to_num(delta_e) / 40, 0, 1)[..., None], 3, axis=-1)
        maps.append(np.where(np.isnan(delta_e)[..., None], [0.1, 0.15, 0.35], grey))
    return np.concatenate([source, target, *maps], axis=1)


def table(rows: Sequence[Row]) -> str:
    """Markdown: mean DeltaE of the edited object, exact, along the flow, and along it at the exact figure's pixels; and the
    flow's own errors in the whole picture.
    """
    shown = ("truth", "one answer", f"{SLIP} px slip", "two answers")
    head = ["scene", "yaw", "object px", *shown]
    head += ["EPE median, p95 (px)", "check passes", "not in source"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        cells = [row.scene, f"{row.yaw:g}", f"{row.figures['truth']['consistency.pixels']:g}"]
        for kind in PAIRS:
            found = row.figures[kind]
            names = ("delta_e", "flow_delta_e", "flow_same_delta_e")
            cells.append(" / ".join(f"{found[f'consistency.{name}']:.1f}" for name in names))
        cells.append(f"{row.flow['consistency.flow_epe_median']:.2f}, {row.flow['consistency.flow_epe_p95']:.1f}")
        cells += [f"{row.flow['consistency.flow_recall']:.0%}", f"{row.flow['consistency.flow_false']:.0%}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m attnwarp_eval.flow_study",
        description="Consistency of two views, exact and along optical flow.",
    )
    parser.add_argument("--scenes", nargs="+", choices=sorted(SCENES), default=list(SCENES), help="default: all")
    parser.add_argument("--yaws", nargs="+", type=float, default=list(YAWS), help="degrees from the source")
    parser.add_argument("--size", type=int, default=256, help="of the pictures in px (default 256)")
    parser.add_argument("--spp", type=int, default=32, help="samples a pixel (default 32)")
    parser.add_argument("--method", choices=("dis", "farneback"), default="dis", help="of OpenCV's flow (default dis)")
    parser.add_argument("--out", type=Path, help="folder for flow.json and a picture of each pair")
    options = parser.parse_args(arguments)

    def keep(name: str, image: Any) -> None:
        import cv2

        pixels = np.round(255 * image[..., ::-1]).astype(np.uint8)
        if not cv2.imwrite(str(options.out / f"{name}.png"), pixels):
            raise OSError(f"{options.out / name}.png: could not be written")

    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for name in options.scenes:
        for row in study(
            name, SCENES[name], size=options.size, spp=options.spp, yaws=options.yaws, method=options.method,
            keep=keep if options.out else None,
        ):  # fmt: skip
            rows.append(row)
    print(table(rows))
    if options.out:
        (options.out / "flow.json").write_text(json.dumps(_plain([asdict(row) for row in rows]), indent=1) + "\n")


def _plain(value: Any) -> Any:
    """With null for NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and np.isnan(value) else value


if __name__ == "__main__":
    main()
