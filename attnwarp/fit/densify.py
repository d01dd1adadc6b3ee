"""Adaptive density control (3DGS), for both kinds: adding and removing splats.

A large loss gradient in a splat's screen position means too few or too large splats nearby: small
splats are cloned, large ones split in two. Nearly transparent and far too large splats are removed.
At intervals every opacity is lowered, so that unneeded splats stay low and are removed.

Two things differ from the published code. The gradient on screen is computed from the one in space
(see :func:`screen_gradient`). And a splat's size is compared with the extent of the scene or the
splat's distance from the scene's middle, whichever is larger: splats of a sky or of far hills are
large without being too large.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from attnwarp.camera import Camera
from attnwarp.fit.model import NAMES, Model
from attnwarp.fit.settings import FitSettings
from attnwarp.gaussians import Gaussians

Tensor = torch.Tensor

GROW_SCALE = 0.01
"""Largest size of a small splat, as a share of the extent (published)."""

SPLIT_SHRINK = 1.6
"""Shrink factor of the two halves of a split splat (published)."""

RECOVERY = 100
"""Iterations after a reset in which no opacity is reason to go (published: the next refinement is
100 later); Adam needs 40 of them from the reset's opacity to the floor of 2DGS."""


def screen_gradient(
    gradient: Tensor, means: Tensor, camera: Camera, origin: np.ndarray, near: float
) -> Tensor:
    """Compute the length of the loss's gradient in each splat's screen position, (N,), for a screen
    2 wide and 2 high.

    Let c = R m + t be the centre in camera axes and (x, y) = ((fx X + s Y) / Z, fy Y / Z) its
    pixel, s the skew. A loss that depends on a centre only through its pixel has dL/dX = fx / Z
    dL/dx and dL/dY = (s dL/dx + fy dL/dy) / Z. So the two components of R dL/dm across the view
    give the gradient on screen. Contributions through the centre's depth, the view direction and
    the outline are included here; the published code omits them or, for 2DGS, overwrites them. A
    screen 2 wide makes the thresholds of 3DGS independent of the image's size.

    Args:
        gradient, means: (N, 3) in world axes, ``means`` relative to ``origin``.
        near: depth in scene units below which a centre has no position on screen and the result
            is 0.
    """
    device = means.device
    R = torch.tensor(camera.rotation, device=device)
    moved = torch.tensor(camera.rotation @ origin + camera.translation, device=device)
    z = means.double() @ R[2] + moved[2]
    across = gradient.double() @ R[:2].T
    across[:, 1] -= float(camera.K[0, 1] / camera.K[0, 0]) * across[:, 0]
    focal = torch.tensor([camera.K[0, 0], camera.K[1, 1]], dtype=torch.float64, device=device)
    half = torch.tensor([camera.width / 2, camera.height / 2], dtype=torch.float64, device=device)
    on_screen = across * z[:, None] / focal * half
    return torch.where(z > near, on_screen.norm(dim=1), 0.0).float()


class Density:
    """Collector of gradients that adds and removes splats at intervals of ``densify_every``.

    Attributes:
        total, seen: (N,) sum of the gradients' lengths since the last refinement, and number of
            views that showed the splat.
    """

    def __init__(
        self,
        settings: FitSettings,
        extent: float,
        center: np.ndarray,
        count: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.settings, self.extent = settings, extent
        self.center = torch.tensor(np.asarray(center, dtype=np.float32), device=device)
        self.clear(count)
        iterations = settings.iterations
        self.last = int(settings.densify_until * iterations)
        self.every = max(settings.densify_least, round(settings.densify_every * iterations))
        self.reset = max(settings.reset_least, round(settings.reset_every * iterations))

    def clear(self, count: int) -> None:
        """Forget the gradients; ``count``: number of splats."""
        self.total = torch.zeros(count, dtype=torch.float32, device=self.center.device)
        self.seen = torch.zeros_like(self.total)

    def watch(self, model: Model, gaussians: Gaussians, camera: Camera, weight: Tensor) -> None:
        """Record one view's gradients before the optimiser clears them."""
        means = model.tensors["means"]
        if means.grad is None:
            return
        visible = weight > 0
        length = screen_gradient(
            means.grad, means.detach(), camera, gaussians.origin, self.settings.near * self.extent
        )
        self.total += torch.where(visible, length, 0.0)
        self.seen += visible

    def active(self, iteration: int) -> bool:
        """Return True if splats may still be added after ``iteration`` iterations."""
        return self.settings.densify and 0 < iteration < self.last

    def refine(self, model: Model, iteration: int, random: torch.Generator) -> bool:
        """Add and remove splats if due; return True if the model changed."""
        s = self.settings
        if not self.active(iteration):
            return False
        done = False
        if iteration >= s.densify_from * s.iterations and iteration % self.every == 0:
            # Published: after the first opacity reset, which a short fit lacks. By half of the
            # time, initially too large splats have been split or have shrunk.
            sizes_count = iteration > min(self.reset, self.last / 2)
            recovered = iteration <= self.reset or iteration % self.reset >= RECOVERY
            self._grow_and_prune(model, sizes_count, recovered, random)
            done = True
        if iteration % self.reset == 0:
            model.lower_opacity(s.reset_opacity)
            done = True
        return done

    def _room(self, model: Model) -> Tensor:
        """Compute each splat's reference length for its size, (N,)."""
        away = (model.tensors["means"].detach() - self.center).norm(dim=1)
        return away.clamp_min(self.extent)

    def _grow_and_prune(
        self, model: Model, sizes_count: bool, recovered: bool, random: torch.Generator
    ) -> None:
        s = self.settings
        t = {name: tensor.detach() for name, tensor in model.tensors.items()}
        gradient = self.total / self.seen.clamp_min(1)
        room = self._room(model)
        largest = t["scales"].exp().amax(dim=1)
        gone = (t["opacity"].sigmoid() < s.opacity_floor) & recovered
        if sizes_count:
            gone |= largest > s.prune_scale * room
        wanted = (gradient > s.grow_gradient) & ~gone
        if s.max_splats is not None:
            # Cloning and splitting each add one splat.
            spare = max(0, s.max_splats - int((~gone).sum()))
            if int(wanted.sum()) > spare:
                # Stable sort, so that the choice between equal gradients does not depend on the
                # sorting method.
                order = torch.argsort(
                    torch.where(wanted, gradient, -1.0), descending=True, stable=True
                )
                wanted = torch.zeros_like(wanted)
                wanted[order[:spare]] = True
        small = largest <= GROW_SCALE * room
        cloned = torch.nonzero(wanted & small)[:, 0]
        split = torch.nonzero(wanted & ~small)[:, 0]
        keep = torch.nonzero(~gone & ~(wanted & ~small))[:, 0]
        halves = [self._half(t, split, random) for _ in range(2)]
        added = {
            name: torch.cat([t[name][cloned], *(half[name] for half in halves)]) for name in NAMES
        }
        if len(keep) + len(added["means"]) == 0:
            raise RuntimeError(
                f"every one of the {len(model)} splats fell below prune_opacity {s.opacity_floor:g}"
                f" or above prune_scale {s.prune_scale:g}: the views do not show what the first"
                " splats describe; check that cameras and points are in one coordinate system"
            )
        model.replace(keep, added)
        self.clear(len(model))

    def _half(
        self, t: dict[str, Tensor], index: Tensor, random: torch.Generator
    ) -> dict[str, Tensor]:
        """Create one half of a split splat: a smaller copy at a point drawn from the splat's
        Gaussian.
        """
        half = {name: tensor[index].clone() for name, tensor in t.items()}
        scales = half["scales"].exp()
        # Drawn on the CPU, so that every device grows the same splats.
        drawn = torch.randn(scales.shape, generator=random, dtype=torch.float32)
        offset = drawn.to(scales.device) * scales
        if scales.shape[1] == 2:
            offset = torch.nn.functional.pad(offset, (0, 1))
        kind = self.settings.kind
        axes = Gaussians(
            kind, half["means"], half["quats"], scales, half["opacity"].sigmoid(), half["dc"]
        ).rotations()
        half["means"] += (axes @ offset[:, :, None])[:, :, 0]
        half["scales"] -= float(np.log(SPLIT_SHRINK))
        return half

    def state(self) -> dict[str, Any]:
        """Collect the state that the next refinement depends on."""
        return {"total": self.total.cpu().clone(), "seen": self.seen.cpu().clone()}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state`."""
        device = self.center.device
        self.total = state["total"].to(device, copy=True)
        self.seen = state["seen"].to(device, copy=True)
