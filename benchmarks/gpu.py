"""Figures of the GPU backend, in one command: ``python -m benchmarks.gpu``.

- Agreement: pictures and gradients of the GPU against the CPU backend's.
- Rendering at 512 px with 50,000, 200,000 and 1,000,000 splats, forward and backward, beside gsplat
  in the same process where it is installed. gsplat has no median depth, no normals of 3D splats and
  no distortion that is exact, so it does less.
- A fit of 64 views at 256 px with 30,000 splats.
- An edit of 64 views at 512 px with networks of Stable Diffusion 1.5's sizes and random weights,
  and again with ``--low-memory``.

Each has the most memory that torch held on the GPU. Without a GPU there is nothing to measure: the
command says so and exits with code 2. ``--device cpu`` runs everything on Warp's CPU device, to see
that it runs; with ``--tiny``, in minutes.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.gaussians import Gaussians
from attnwarp.render import render
from benchmarks import command
from benchmarks.render import camera, scene

HELD_OUT = 2
"""Views that the fit is evaluated on, beside those that it is fitted on."""

NO_GPU = "no GPU that torch can use: nothing is measured; --device cpu --tiny only tries the script"


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of what is measured."""

    pixels: int = 512
    splats: tuple[int, ...] = (50_000, 200_000, 1_000_000)
    rounds: int = 20
    views: int = 64
    fit_pixels: int = 256
    fit_splats: int = 30_000
    fit_iterations: int = 3_000
    edit_pixels: int = 512
    edit_steps: int = 20
    edit_iterations: int = 3_000
    edit_views_per_stage: int = 9
    channels: tuple[int, ...] = (320, 640, 1280, 1280)  # of Stable Diffusion 1.5's UNet
    context: int = 768
    text_layers: int = 12
    coder: tuple[int, ...] = (128, 256, 512, 512)


TINY = Sizes(
    64, (300,), 2, 3, 32, 200, 20, 32, 2, 3, 1, channels=(32, 64), context=32, text_layers=1,
    coder=(32, 32, 32, 32),
)  # fmt: skip


def wait(device: str) -> None:
    """Wait for everything that was queued."""
    if device != "cpu":
        torch.cuda.synchronize(device)


def peak_bytes(device: str, work: Callable[[], Any]) -> tuple[Any, int | None]:
    """A result, and the most bytes that torch held on the GPU meanwhile; None on a CPU."""
    if device == "cpu":
        return work(), None
    torch.cuda.reset_peak_memory_stats(device)
    result = work()
    wait(device)
    return result, torch.cuda.max_memory_allocated(device)


def milliseconds(work: Callable[[], Any], device: str) -> float:
    """Milliseconds of one call, from an idle device to an idle device."""
    wait(device)
    start = time.perf_counter()
    work()
    wait(device)
    return 1e3 * (time.perf_counter() - start)


def leaves_of(splats: Gaussians) -> Gaussians:
    """The splats with parameters that take gradients."""
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(
        splats.kind, *(getattr(splats, name).clone().requires_grad_() for name in names)
    )


def differentiate(outputs: Sequence[torch.Tensor]) -> None:
    """A backward pass with upstream gradients of ones."""
    torch.autograd.backward(list(outputs), [torch.ones_like(output) for output in outputs])


def agreement(device: str, sizes: Sizes) -> list[dict[str, Any]]:
    """The largest difference of a picture of each kind, and of its gradients, to the CPU backend's:
    of 1, and of the largest gradient."""
    rows = []
    for kind in ("2d", "3d"):
        start, view = scene(kind, 2_000, 0.05), camera(min(256, sizes.pixels))
        colors, grads = [], []
        for place, backend in (("cpu", "cpu"), (device, "gpu")):
            splats = leaves_of(start.to(device=place))
            made = render(splats, view, backend=backend)
            differentiate([made.color, made.alpha, made.normal, made.distortion_ordered])
            colors.append(made.color.detach().cpu())
            assert splats.means.grad is not None
            grads.append(splats.means.grad.cpu())
        rows.append(
            {
                "kind": kind,
                "color": float((colors[0] - colors[1]).abs().max()),
                "gradient": float((grads[0] - grads[1]).abs().max() / grads[0].abs().max()),
            }
        )
    return rows


def by_gsplat(splats: Gaussians, view: Camera) -> list[torch.Tensor]:
    """Outputs of gsplat: colour and centre depth, alpha; of 2D splats normals too."""
    from gsplat import rasterization, rasterization_2dgs

    device = splats.means.device
    common = {
        "means": splats.means, "quats": splats.quats, "opacities": splats.opacities,
        "colors": splats.sh, "sh_degree": 0, "render_mode": "RGB+ED",
        "viewmats": torch.tensor(view.world_to_camera, dtype=torch.float32, device=device)[None],
        "Ks": torch.tensor(view.K, dtype=torch.float32, device=device)[None],
        "width": view.width, "height": view.height, "near_plane": 0.01,
    }  # fmt: skip
    if splats.kind == "3d":
        pictures, alphas, _ = rasterization(scales=splats.scales, **common)
        return [pictures, alphas]
    flat = torch.cat([splats.scales, torch.ones_like(splats.scales[:, :1])], dim=1)
    pictures, alphas, normals, *_ = rasterization_2dgs(scales=flat, **common)
    return [pictures, alphas, normals]


def by_us(splats: Gaussians, view: Camera) -> list[torch.Tensor]:
    """The outputs of the GPU backend that a loss reads."""
    made = render(splats, view, backend="gpu")
    return [made.color, made.alpha, made.depth, made.normal]


def time_once(
    draw: Callable[[Gaussians, Camera], list[torch.Tensor]],
    splats: Gaussians,
    view: Camera,
    device: str,
) -> tuple[float, float, int | None]:
    """Milliseconds of a forward pass, and of a backward pass; the most bytes of the latter."""
    with torch.no_grad():
        forward = milliseconds(lambda: draw(splats, view), device)
    traced = leaves_of(splats)

    def backward() -> float:
        outputs = [output.nan_to_num() for output in draw(traced, view)]
        return milliseconds(lambda: differentiate(outputs), device)

    return forward, *peak_bytes(device, backward)


def rendering(device: str, sizes: Sizes) -> list[dict[str, Any]]:
    """Milliseconds of a forward and of a backward pass, medians of contestants in turn, and the
    ratios to gsplat's."""
    contestants = {"attnwarp": by_us}
    if device != "cpu" and importlib.util.find_spec("gsplat") is not None:
        contestants["gsplat"] = by_gsplat
    rows = []
    view = camera(sizes.pixels)
    for kind in ("2d", "3d"):
        for count in sizes.splats:
            # Splats that overlap about as those of a fit do, whatever their number.
            splats = scene(kind, count, 0.6 / count ** (1 / 3)).to(device=device)
            row: dict[str, Any] = {"kind": kind, "splats": count}
            times: dict[tuple[str, str], list[float]] = {}
            for turn in range(sizes.rounds + 2):
                for name, draw in contestants.items():
                    forward, backward, peak = time_once(draw, splats, view, device)
                    if turn < 2:
                        continue  # compiles, and fills torch's pool
                    times.setdefault((name, "forward"), []).append(forward)
                    times.setdefault((name, "backward"), []).append(backward)
                    row[f"{name}_bytes"] = peak
            for (name, part), values in times.items():
                row[f"{name}_{part}_ms"] = round(statistics.median(values), 3)
            for part in ("forward", "backward"):
                if "gsplat" in contestants:
                    ours, theirs = row[f"attnwarp_{part}_ms"], row[f"gsplat_{part}_ms"]
                    row[f"{part}_ratio"] = round(ours / theirs, 2)
            rows.append(row)
    return rows


def ring(count: int, size: int) -> list[Camera]:
    """Cameras around the unit ball."""
    angles = [2 * np.pi * k / count for k in range(count)]
    return [
        Camera.look_at(
            [3 * np.cos(a), 3 * np.sin(a), 0.5 * np.sin(3 * a)], [0, 0, 0], width=size, height=size,
            fov_y=42, name=f"{k:03d}.png",
        )
        for k, a in enumerate(angles)
    ]  # fmt: skip


def photographs(cameras: Sequence[Camera], device: str) -> list[np.ndarray]:
    """Pictures of random splats, in 8 bits."""
    truth = scene("3d", 2_000, 0.1).to(device=device)
    with torch.no_grad():
        views = [render(truth, each, backend="gpu").color.clamp(0, 1) for each in cameras]
    return [(255 * view).round().to(torch.uint8).cpu().numpy() for view in views]


def fitting(device: str, sizes: Sizes) -> dict[str, Any]:
    """Seconds of a fit, and the PSNR that it reaches on views held out."""
    from attnwarp.fit import FitSettings, Views, fit, from_points

    cameras = ring(sizes.views + HELD_OUT, sizes.fit_pixels)
    images = photographs(cameras, device)
    every = len(cameras) // HELD_OUT
    out = set(range(0, HELD_OUT * every, every))
    views, held_out = (
        Views(
            [camera for k, camera in enumerate(cameras) if (k in out) == chosen],
            [image for k, image in enumerate(images) if (k in out) == chosen],
        )
        for chosen in (False, True)
    )
    points = scene("3d", sizes.fit_splats, 0.05).means.double().numpy()
    start = from_points(points, kind="2d", sh_degree=0).to(device=device)
    settings = FitSettings(
        kind="2d", sh_degree=0, iterations=sizes.fit_iterations, max_splats=sizes.fit_splats,
        evaluate_every=sizes.fit_iterations,
    )  # fmt: skip
    result, peak = peak_bytes(
        device, lambda: fit(start, views, settings, held_out=held_out, backend="gpu")
    )
    return {
        "views": len(views),
        "pixels": sizes.fit_pixels,
        "splats": len(result.gaussians),
        "iterations": result.iteration,
        "seconds": round(result.seconds, 2),
        "psnr": round(result.history[-1].psnr, 2),
        "bytes": peak,
    }


def random_editor(device: str, sizes: Sizes, dtype: torch.dtype) -> Any:
    """An InstructPix2Pix of Stable Diffusion 1.5's sizes with random weights."""
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from diffusers.utils import logging
    from transformers import CLIPTextConfig, CLIPTextModel

    from attnwarp.editing.editors.pix2pix import InstructPix2Pix
    from attnwarp.editing.small import load_editor

    logging.set_verbosity_error()
    tokenizer = load_editor("small-plain").parts["tokenizer"]
    tokenizer.model_max_length = 77  # as Stable Diffusion's
    torch.manual_seed(0)
    levels = len(sizes.channels)
    unet = UNet2DConditionModel(
        sample_size=64, in_channels=8, out_channels=4,
        block_out_channels=sizes.channels,
        down_block_types=(*["CrossAttnDownBlock2D"] * (levels - 1), "DownBlock2D"),
        up_block_types=("UpBlock2D", *["CrossAttnUpBlock2D"] * (levels - 1)),
        cross_attention_dim=sizes.context, attention_head_dim=8,
    )  # fmt: skip
    vae = AutoencoderKL(
        block_out_channels=sizes.coder,
        latent_channels=4,
        layers_per_block=2,
        down_block_types=["DownEncoderBlock2D"] * len(sizes.coder),
        up_block_types=["UpDecoderBlock2D"] * len(sizes.coder),
    )
    text = CLIPTextModel(
        CLIPTextConfig(
            vocab_size=49408, hidden_size=sizes.context, intermediate_size=4 * sizes.context,
            num_hidden_layers=sizes.text_layers, num_attention_heads=max(1, sizes.context // 64),
            max_position_embeddings=77,
        )
    )  # fmt: skip
    unet, vae, text = (network.to(device, dtype).eval() for network in (unet, vae, text))
    scheduler = DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False,
        set_alpha_to_one=False, steps_offset=1,
    )  # fmt: skip
    return InstructPix2Pix(unet, vae, text, tokenizer, scheduler)


def editing(
    device: str, sizes: Sizes, dtype: torch.dtype, low_memory: bool = False
) -> dict[str, Any]:
    """Seconds of a whole edit by part; with the option ``--low-memory`` of an edit."""
    from attnwarp.editing.memory import save_memory
    from attnwarp.methods import attention_warping, preset

    cameras = ring(sizes.views, sizes.edit_pixels)
    images = photographs(cameras, device)
    editor = random_editor("cpu" if low_memory else device, sizes, dtype)
    if low_memory:
        save_memory(editor, device)
    splats = scene("2d", sizes.fit_splats, 0.03).to(device=device)
    settings = preset(
        "attention_warping", size=sizes.edit_pixels, steps=sizes.edit_steps,
        iterations=sizes.edit_iterations, views_per_stage=sizes.edit_views_per_stage,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        result, peak = peak_bytes(
            device,
            lambda: attention_warping(
                splats, cameras, images, editor, "make it red", settings, folder=Path(folder),
                store="device", backend="gpu",
            ),
        )  # fmt: skip
        seconds = time.perf_counter() - start
    return {
        "views": sizes.views,
        "edited": len(result.edited),
        "pixels": sizes.edit_pixels,
        "dtype": str(dtype).removeprefix("torch."),
        "parameters": sum(p.numel() for p in editor.unet.parameters()),
        "seconds": round(seconds, 2),
        "parts": {part: round(value, 2) for part, value in result.seconds.items()},
        "bytes": peak,
    }


def run(device: str, sizes: Sizes) -> dict[str, Any]:
    """All figures."""
    card = "Warp's CPU device" if device == "cpu" else torch.cuda.get_device_name(device)
    half = torch.float32 if device == "cpu" else torch.float16
    figures: dict[str, Any] = {"device": card, "torch": torch.__version__}
    for name, measure in (
        ("agreement", lambda: agreement(device, sizes)),
        ("rendering", lambda: rendering(device, sizes)),
        ("fit", lambda: fitting(device, sizes)),
        ("edit", lambda: editing(device, sizes, half)),
        ("edit in low memory", lambda: editing(device, sizes, half, low_memory=True)),
    ):
        print(f"{name} ...", file=sys.stderr)
        figures[name] = measure()
    return figures


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = command.parser("gpu", "Measure the GPU backend: rendering, a fit, an edit, memory.")
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1; cpu only to try the script")
    parser.add_argument("--tiny", action="store_true", help="sizes that a CPU does in minutes")
    options = parser.parse_args(arguments)
    if options.device != "cpu" and not torch.cuda.is_available():
        print(NO_GPU, file=sys.stderr)
        raise SystemExit(2)
    figures = run(options.device, TINY if options.tiny else Sizes())
    for name, value in figures.items():
        rows = value if isinstance(value, list) else [value]
        for row in rows:
            parts = row.items() if isinstance(row, dict) else [("", row)]
            print(f"{name}: " + ", ".join(f"{key} {part}".strip() for key, part in parts))
    command.write_figures(options.out, figures)


if __name__ == "__main__":
    main()
