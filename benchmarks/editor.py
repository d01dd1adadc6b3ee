"""One try of an editor's folder, for whoever has its weights: one HTML file to send back.

The file has versions, announced and measured memory, seconds of plain, recorded and injected edits
in turn, whether a view's own features at full weight give the same bits, and the pictures.

    python -m benchmarks.editor PATH/TO/klein photo.png --instruction "make it red" --out klein.html
"""

from __future__ import annotations

import base64
import json
import platform
import statistics
import time
from collections.abc import Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp.command.marks import read_over_black
from attnwarp.devices import choose
from attnwarp.editing.editor import edit
from attnwarp.editing.layers import choose_layers
from attnwarp.editing.memory import announced, weight_bytes
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.editing.small import dtype_of, load_editor, thread_count
from attnwarp.io.images import encode_png
from attnwarp.methods.algorithms.attention_warping import inject
from attnwarp.methods.pictures import edit_size, resized, to_bytes
from benchmarks import command
from benchmarks.injection import INJECTED, PLAIN, RECORDED, WARPED, measure

PACKAGES = ("attnwarp", "torch", "diffusers", "transformers")


def tried(
    name: str,
    picture: npt.NDArray[np.float32],
    words: str,
    *,
    device: str = "auto",
    dtype: str = "auto",
    size: int | None = None,
    rounds: int = 3,
) -> tuple[dict[str, Any], list[npt.NDArray[np.float32]]]:
    """Try an editor on a picture.

    Args:
        name: name or folder of the editor.
        picture: (H, W, 3) in [0, 1].
        words: the instruction.
        device, dtype: as the commands take them.
        size: longest side in px; the editor's own if omitted.
        rounds: rounds of timing.

    Returns:
        The figures, and the pictures: before, edited, edited with its own features.
    """
    place = choose(device, splats=False)
    kind = dtype_of(dtype, place, name)
    about: dict[str, Any] = {k: version(k) for k in PACKAGES}
    about |= {"machine": platform.platform(), "announced": announced(name, kind, place)}
    about["device"] = place if place == "cpu" else torch.cuda.get_device_name()
    start = time.perf_counter()
    editor = load_editor(name, device=place, dtype=kind)
    about |= {
        "seconds to load": time.perf_counter() - start,
        "weights, GiB": _gib(weight_bytes(editor)),
    }
    torch.set_num_threads(thread_count(editor))
    height, width = picture.shape[:2]
    h, w = edit_size(height, width, size or editor.own_size, editor.side_multiple)
    view = resized(picture, (h, w))
    about |= {"editor": type(editor).__name__, "size": f"{w} x {h}", "steps": editor.own_steps}

    layers = choose_layers(editor.layers())
    keep = tuple(branch for branch in editor.branches if branch in editor.carries)
    plan = RecordingPlan(
        layers, editor.noise_shape((h, w))[1:], keep, editor.own_steps, store="cpu"
    )
    about["features, GiB"] = _gib(plan.bytes)
    if place != "cpu":
        torch.cuda.reset_peak_memory_stats()
    first = edit(editor, [view], words)
    if place != "cpu":
        about["peak, GiB"] = _gib(torch.cuda.max_memory_allocated())
    with record(editor, plan) as recording:
        again = edit(editor, [view], words)
    with inject(editor, recording, weight=lambda t, T: 1.0):
        own = edit(editor, [view], words)
    about["recording changes no bit"] = torch.equal(first.latents, again.latents)
    about["own features give the same bits"] = torch.equal(first.latents, own.latents)
    del recording
    runs = measure(editor, max(h, w), steps=editor.own_steps, rounds=rounds)
    walls = {name: [seconds.wall for seconds in run] for name, run in runs.items()}
    about["seconds of an edit"] = statistics.median(walls[PLAIN])
    for run in (RECORDED, INJECTED, WARPED):
        shares = [one / plain for one, plain in zip(walls[run], walls[PLAIN], strict=True)]
        about[f"{run}, x plain"] = statistics.median(shares)
    return about, [view, first.images[0], own.images[0]]


def page(about: dict[str, Any], pictures: Sequence[npt.NDArray[np.float32]]) -> str:
    """Write the figures and the pictures as one HTML file."""
    rows = "".join(
        f"<tr><td>{escape(name)}<td>{escape(f'{v:.4g}' if isinstance(v, float) else str(v))}"
        for name, v in about.items()
    )
    shown = "".join(
        f'<img src="data:image/png;base64,{base64.b64encode(encode_png(to_bytes(p))).decode()}">'
        for p in pictures
    )
    data = json.dumps(about).replace("<", "\\u003c")
    return (
        f"<!doctype html><meta charset=utf-8><title>{escape(str(about['editor']))}</title>"
        f"<table>{rows}</table><p>before, edited, edited with its own features</p>{shown}"
        f'<script type="application/json">{data}</script>'
    )


def _gib(count: int) -> float:
    return count / 2**30


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("editor", "Try an editor's folder; writes one HTML file.")
    parser.add_argument("editor", help="name or folder")
    parser.add_argument("picture", type=Path, help="PNG or JPEG file")
    parser.add_argument("--instruction", required=True, help="what to make of it")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--dtype", default="auto")
    parser.add_argument("--size", type=int, help="longest side in px; the editor's own if left out")
    parser.add_argument("--rounds", type=int, default=3, help="times each run is measured")
    options = parser.parse_args(arguments)
    pixels, top = read_over_black(options.picture)
    picture = (pixels / top).astype(np.float32)
    about, pictures = tried(
        options.editor, picture, options.instruction, device=options.device,
        dtype=options.dtype, size=options.size, rounds=options.rounds,
    )  # fmt: skip
    out = options.out or Path(f"{about['editor']}.html")
    command.write_text(out, page(about, pictures))
    print(out)


if __name__ == "__main__":
    main()
