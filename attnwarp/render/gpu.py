"""The GPU backend: Warp kernels, float32 with a float64 projection, and the definition of the
reference.

1. Projection: each splat's outline, depth and colour as seen by the camera, in float64.
2. Ordering: a radix sort by depth; ties are broken by the splats' parameters.
3. Binning: an entry for each tile of 8 x 8 pixels that a splat may cover, by exact outlines; a
   stable radix sort by tile. Terms linear in a pixel's position are evaluated in float64 at the
   tile's middle.
4. Compositing, one thread a pixel, until the 32 pixels of a warp are opaque.
5. Backward: each pixel's splats back to front. A splat's gradients are summed over a warp's
   pixels, then added to its row in float64, and taken to the parameters and the pose.

The host waits for the device once per picture, for the number of entries and of ties; once more if
the pose has a gradient. Pictures and weights have the same bits in every run, gradients up to the
order of sums in float64: 1e-15 of the largest term.

Kernels run on the splats' device. For CPU tensors that is Warp's CPU device, on one thread: far
slower than backend "cpu", with the same results. Tests use this device; the backend has never run
on a GPU.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from attnwarp.errors import optional_imports
from attnwarp.process import kernel_folders
from attnwarp.render.interface import OUTPUTS, PICTURES, Inputs, Outputs

with optional_imports():
    import warp as wp

Tensor = torch.Tensor

PRECISE = torch.float64
"""Type of the projection and of the sums of gradients."""

MOST_ENTRIES = 2**31 - 1
"""Largest number of entries of a picture: their numbers are int32."""


def _cache_folder() -> str | None:
    """Choose the folder of compiled kernels if Warp's default is not writable."""
    own = os.environ.get("WARP_CACHE_PATH")
    folder = Path(own) if own else Path.home() / ".cache"
    while not folder.exists():
        folder = folder.parent
    if own or os.access(folder, os.W_OK):
        return None
    return str(next(kernel_folders("warp"), None) or tempfile.mkdtemp())


wp.config.log_level = wp.LOG_WARNING
wp.config.kernel_cache_dir = wp.config.kernel_cache_dir or _cache_folder()
wp.init()

from attnwarp.render._gpu import (  # noqa: E402
    backward,
    binning,
    compositing,
    layout,
    projection,
    projection_backward,
)
from attnwarp.render._gpu.lanes import COLUMNS  # noqa: E402

MODULES = (projection, binning, compositing, backward, projection_backward)
"""Modules that have kernels."""


@contextlib.contextmanager
def _on(device: torch.device) -> Iterator[None]:
    """Launch on torch's stream, so that work queued by torch runs first."""
    if device.type == "cuda":
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device))):
            yield
    else:
        yield


def _launch(kernel: Any, count: int, device: torch.device, *arguments: Any) -> None:
    """Launch ``count`` threads; tensors are passed without a copy."""
    if count == 0:
        return
    given = [
        wp.from_torch(value.detach(), return_ctype=True) if isinstance(value, Tensor) else value
        for value in arguments
    ]
    wp.launch(kernel, dim=count, inputs=given, device=wp.device_from_torch(device), block_dim=64)


@dataclass(frozen=True)
class _Splats:
    """N splats in the kernels' format: all float32, or all float64; values float32."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    values: Tensor

    @property
    def parts(self) -> tuple[Tensor, ...]:
        return self.means, self.quats, self.scales, self.opacities, self.values

    @property
    def real(self) -> Any:
        """Type of the splats in kernels."""
        return wp.float32 if self.means.dtype == torch.float32 else wp.float64


@dataclass(frozen=True)
class _Drawn:
    """State passed from the forward pass to the backward pass."""

    view: Any
    splats: _Splats
    features: Tensor  # (N, C), or no rows where three channels are all
    background: Tensor
    doubles: Tensor  # (N, DOUBLES)
    singles: Tensor  # (N, SINGLES)
    terms: Tensor  # (entries, TERMS)
    entries: Tensor  # (entries,) int32, splats
    bounds: Tensor  # (tiles, 2) int32
    state: Tensor  # (H, W) float32, the transmittance behind all splats
    steps: Tensor  # (2, H, W) int32
    counters: dict[str, int]

    @property
    def device(self) -> torch.device:
        return self.singles.device

    @property
    def threads(self) -> int:
        return len(self.bounds) * layout.PIXELS


def _view(inputs: Inputs) -> Any:
    pose, K = inputs.pose.detach().double().cpu(), inputs.K.double().cpu()
    rotation = pose[:3, :3]
    moved = rotation @ inputs.origin.double().cpu() + pose[:3, 3]
    view = layout.View()
    view.rotation, view.translation = wp.mat33d(*rotation.flatten().tolist()), wp.vec3d(*moved)
    view.fx, view.skew, view.fy = float(K[0, 0]), float(K[0, 1]), float(K[1, 1])
    view.cx, view.cy = float(K[0, 2]), float(K[1, 2])
    view.near, view.blur = inputs.near, float(inputs.screen_filter)
    view.width, view.height = inputs.width, inputs.height
    view.across, view.down = (-(-size // layout.TILE) for size in (inputs.width, inputs.height))
    view.discs, view.by_center = inputs.kind == "2d", inputs.depth == "center"
    view.antialiased, view.harmonic = inputs.antialiased, inputs.harmonic
    view.degree = round(inputs.values.shape[1] ** 0.5) - 1 if inputs.harmonic else 0
    view.channels = inputs.channels
    return view


def _splats(inputs: Inputs) -> _Splats:
    parts = [part.detach() for part in (inputs.means, inputs.quats, inputs.scales)]
    parts.append(inputs.opacities.detach())
    # Kernels are compiled for both types, but not for all mixtures.
    dtype = torch.float32 if all(part.dtype == torch.float32 for part in parts) else torch.float64
    values = inputs.values.detach().flatten(1).float().contiguous()
    means, quats, scales, opacities = (part.to(dtype).contiguous() for part in parts)
    return _Splats(means, quats, scales, opacities, values)


def _sort(keys: Tensor, values: Tensor, bits: int | None = None) -> None:
    """Sort ``values`` by ``keys``, stably, in place; both have double capacity."""
    count = len(keys) // 2
    wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, 0, bits)


def _twice(values: Tensor) -> Tensor:
    """Copy values to a tensor of double capacity."""
    room = values.new_empty(2 * len(values))
    room[: len(values)] = values
    return room


def _by_depth(depths: Tensor) -> tuple[Tensor, Tensor]:
    """Return depths in ascending order, and the splats in this order."""
    keys = _twice(depths)
    order = _twice(torch.arange(len(depths), dtype=torch.int32, device=depths.device))
    _sort(keys, order)
    return keys[: len(depths)], order[: len(depths)]


def _with_ties_broken(depths: Tensor, splats: _Splats) -> tuple[Tensor, Tensor]:
    """Return the result of ``_by_depth`` with splats of equal depth ordered by their parameters, as
    in :func:`attnwarp.render.order.break_ties`."""
    count = len(depths)
    order = _twice(torch.arange(count, dtype=torch.int32, device=depths.device))
    # The least significant key first. Adding 0 takes the sign from zeros.
    for key in (*(splats.means[:, axis] + 0.0 for axis in (2, 1, 0)), depths):
        keys = _twice(key[order[:count].long()])
        _sort(keys, order)
    sorted_depths, order = keys[:count], order[:count]
    result = torch.empty_like(order)
    _launch(
        binning.BREAK_TIES[splats.real], count, depths.device,
        sorted_depths, order, splats.means, splats.scales, splats.quats,
        splats.opacities[:, None], splats.values, result,
    )  # fmt: skip
    return sorted_depths, result


def _draw(inputs: Inputs) -> tuple[_Drawn, tuple[Tensor, ...], Tensor]:
    """Run the forward pass: return its state, the pictures as in PICTURES, and the weights."""
    with _on(inputs.means.device):
        return _draw_here(inputs)


def _draw_here(inputs: Inputs) -> tuple[_Drawn, tuple[Tensor, ...], Tensor]:
    view, splats, device = _view(inputs), _splats(inputs), inputs.means.device
    n, tiles = len(splats.means), view.across * view.down
    single: dict[str, Any] = {"dtype": torch.float32, "device": device}
    whole: dict[str, Any] = {"dtype": torch.int32, "device": device}
    doubles = torch.empty(n, layout.DOUBLES, dtype=PRECISE, device=device)
    singles = torch.empty(n, layout.SINGLES, **single)
    depths, counts = torch.empty(n, **single), torch.empty(n, **whole)
    _launch(
        projection.PROJECT[splats.real],
        n,
        device,
        view,
        *splats.parts,
        doubles,
        singles,
        depths,
        counts,
    )
    sorted_depths, order = _by_depth(depths) if n else (depths, counts)
    shown = torch.isfinite(sorted_depths)
    ties = ((sorted_depths[1:] == sorted_depths[:-1]) & shown[1:]).sum()
    # The only synchronisation with the device.
    total, visible, tied = torch.stack([counts.sum(), shown.sum(), ties]).tolist()
    if total > MOST_ENTRIES:
        raise RuntimeError(
            f"gaussians: {total} pairs of a splat and a tile of {layout.TILE} x {layout.TILE}"
            f" pixels, more than {MOST_ENTRIES}; render a smaller picture or fewer large splats"
        )
    if tied:
        _, order = _with_ties_broken(depths, splats)
    ends = torch.cumsum(counts[order.long()], 0, dtype=torch.int64)
    tile_of, entries = torch.empty(2 * total, **whole), torch.empty(2 * total, **whole)
    _launch(
        binning.write_entries, n, device,
        view, doubles, singles, order, counts, ends, tile_of, entries,
    )  # fmt: skip
    if total:
        _sort(tile_of, entries, max(1, tiles.bit_length()))
    entries = entries[:total].clone()
    terms = torch.empty(total, layout.TERMS, **single)
    bounds = torch.zeros(tiles, 2, **whole)
    _launch(binning.lay_out, total, device, view, doubles, tile_of, entries, total, bounds, terms)
    h, w = inputs.height, inputs.width
    color, normal = torch.empty(h, w, inputs.channels, **single), torch.empty(h, w, 3, **single)
    alpha, depth, median, ordered = (torch.empty(h, w, **single) for _ in range(4))
    pictures = (color, alpha, depth, median, normal, ordered)
    state, steps = torch.empty(h, w, **single), torch.empty(2, h, w, **whole)
    background = inputs.background.detach().float().contiguous()
    features = splats.values[:0] if inputs.harmonic else splats.values
    sums = torch.zeros(n, dtype=torch.int64, device=device)
    _launch(
        compositing.composite, tiles * layout.PIXELS, device,
        view, singles, features, terms, entries, bounds, background, *pictures, state, steps, sums,
    )  # fmt: skip
    weight = (sums.double() / layout.WEIGHT_UNIT).float()
    counters = {"splats": n, "visible": visible, "tiles": tiles, "tile_pairs": total}
    drawn = _Drawn(
        view, splats, features, background, doubles, singles, terms, entries, bounds, state, steps,
        counters,
    )  # fmt: skip
    return drawn, pictures, weight


class _Composite(torch.autograd.Function):
    """All kernels as one differentiable step from the tensors of ``Inputs`` to those of
    ``Outputs``.
    """

    @staticmethod
    def forward(
        ctx: Any, inputs: Inputs, kept: list[_Drawn], *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        drawn, pictures, weight = _draw(inputs)
        kept.append(drawn)
        ctx.origin = inputs.origin.double().cpu()
        ctx.shapes = [(t.shape, t.dtype) for t in tensors]
        ctx.set_materialize_grads(False)
        # Saved so that torch detects an in-place change before the backward pass.
        ctx.save_for_backward(*tensors)
        if any(ctx.needs_input_grad):
            # Copies of two outputs read by the backward pass: the caller may change the originals.
            made = dict(zip(PICTURES, pictures, strict=True))
            ctx.drawn, ctx.maps = drawn, {name: made[name].clone() for name in ("alpha", "depth")}
        return *pictures, weight

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Any, ...]:
        _ = ctx.saved_tensors
        drawn, maps = ctx.drawn, ctx.maps
        with _on(drawn.device):
            return (
                None,
                None,
                *_gradients(ctx, drawn, maps, dict(zip(OUTPUTS, upstream, strict=True))),
            )


def _gradients(
    ctx: Any, drawn: _Drawn, maps: dict[str, Tensor], upstream: dict[str, Tensor | None]
) -> list[Tensor | None]:
    """Compute gradients of the tensors of ``Inputs`` from those of the outputs."""
    device, view, splats = drawn.device, drawn.view, drawn.splats
    n, channels = len(splats.means), view.channels
    image = tuple(drawn.state.shape)
    shapes = {"color": (*image, channels), "normal": (*image, 3), "weight": (n,)}
    given = {
        name: torch.zeros(shapes.get(name, image), dtype=torch.float32, device=device)
        if grad is None
        else grad.float().contiguous()
        for name, grad in upstream.items()
    }
    extra = max(0, channels - 3)
    total = torch.zeros(n, COLUMNS + extra, dtype=PRECISE, device=device)
    _launch(
        backward.composite_backward, drawn.threads, device,
        view, drawn.singles, drawn.features, drawn.terms, drawn.entries, drawn.bounds,
        drawn.background, maps["alpha"], maps["depth"], drawn.state, drawn.steps,
        given["color"], given["alpha"], given["depth"], given["median_depth"], given["normal"],
        given["distortion_ordered"], given["weight"], total,
    )  # fmt: skip
    made = [torch.zeros_like(part) for part in splats.parts]
    with_pose = bool(ctx.needs_input_grad[7])
    d_view = torch.zeros(12, dtype=PRECISE, device=device)
    _launch(
        projection_backward.PROJECT_BACKWARD[splats.real], -(-n // 32) * 32, device,
        view, n, with_pose, *splats.parts, drawn.doubles, drawn.singles, total, *made, d_view,
    )  # fmt: skip
    grads: list[Tensor | None] = [*made, None, None]
    if with_pose:
        moved = d_view.cpu()
        pose = torch.zeros(4, 4, dtype=PRECISE)
        pose[:3, :3] = moved[:9].reshape(3, 3) + torch.outer(moved[9:], ctx.origin)
        pose[:3, 3] = moved[9:]
        grads[5] = pose
    if ctx.needs_input_grad[8]:
        through = (1 - maps["alpha"]).double()
        grads[6] = torch.einsum("hwc,hw->c", given["color"].double(), through)
    return [
        grad.to(dtype).reshape(shape) if needed and grad is not None else None
        for grad, (shape, dtype), needed in zip(
            grads, ctx.shapes, ctx.needs_input_grad[2:], strict=True
        )
    ]


def render(inputs: Inputs) -> Outputs:
    """Render on the splats' device; see :func:`attnwarp.render.render`."""
    kept: list[_Drawn] = []
    *pictures, weight = _Composite.apply(inputs, kept, *inputs.leaves)
    named = dict(zip(PICTURES, pictures, strict=True))
    return Outputs(**named, weight=weight, counters=kept[0].counters)
