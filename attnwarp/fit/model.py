"""State of the optimisation: the splats as unconstrained numbers, and Adam's moments."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

# The function, not the class: torch.optim.Adam imports torch's compiler, which takes a second.
from torch.optim.adam import adam

from attnwarp import check
from attnwarp.fit.settings import FitSettings
from attnwarp.gaussians import Gaussians
from attnwarp.io.ply import split_origin

Tensor = torch.Tensor

NAMES = ("means", "dc", "rest", "opacity", "scales", "quats")

SMALLEST, LARGEST = 1e-7, 30
"""Limits of scales as shares of the extent, for scales with a learning rate: smaller ones leave
float32, larger ones spoil depth wherever they show."""

LARGEST_SKY = 0.1
"""Limit of the scales of sky splats as a share of ``far``, hardly more than they begin with: none
grows over the horizon, where it would stand in for surfaces."""

EPSILON = 1e-15
"""Adam's epsilon (3DGS): gradients of a mean over pixels are tiny and must not be damped."""

LARGEST_LOGIT = 15.0
"""Limit of opacity's logit: opacity stays within sigmoid(+-15), 3e-7 from 0 and 1, where its
float32 gradient can still bring it back.
"""


def adam_step(tensor: Tensor, first: Tensor, second: Tensor, steps: int, rate: float) -> None:
    """Take one Adam step along a leaf's gradient, in place, then clear the gradient."""
    assert tensor.grad is not None
    adam(
        [tensor.detach()],
        [tensor.grad],
        [first],
        [second],
        [],
        [torch.tensor(float(steps), dtype=torch.float32, device=tensor.device)],
        fused=True,
        amsgrad=False,
        beta1=0.9,
        beta2=0.999,
        lr=rate,
        weight_decay=0.0,
        eps=EPSILON,
        maximize=False,
    )
    tensor.grad = None


class Model:
    """Splats as optimised by Adam: centres, harmonics, logit of opacity, logarithm of scales,
    quaternions.

    Attributes:
        origin: (3,) float64 world coordinates of the origin of "means".
        tensors: leaves by name: "means" (N, 3), "dc" (N, 1, 3), "rest" (N, K - 1, 3), "opacity"
            (N,) logits, "scales" (N, 2 or 3) logarithms, "quats" (N, 4).
        first, second: Adam's moments by name.
        floor: direction up, (3,), and least height of a sky splat along it from the origin, in
            scene units; None sets no bound.
    """

    floor: tuple[Tensor, float] | None = None

    def __init__(self, start: Gaussians, settings: FitSettings, extent: float) -> None:
        self.settings, self.extent = settings, extent
        self.antialiased = settings.antialiased
        self.screen_filter, self.far = start.screen_filter, start.far
        g = start.detach().to(dtype=torch.float32)
        # float32 would round float64 centres far from zero.
        offset, means = split_origin(start.means.detach().cpu().numpy())
        self.origin = start.origin + offset
        self.tensors: dict[str, Tensor] = {
            "means": torch.tensor(means, device=g.means.device),
            "dc": g.sh[:, :1].clone(),
            "rest": g.sh[:, 1:].clone(),
            "opacity": torch.logit(g.opacities, eps=1e-6),
            "scales": g.scales.log(),
            "quats": g.quats.clone(),
        }
        self.rates = {
            "means": settings.lr_means * extent,
            "dc": settings.lr_dc,
            "rest": settings.lr_rest,
            "opacity": settings.lr_opacity,
            "scales": settings.lr_scales,
            "quats": settings.lr_quats,
        }
        for tensor in self.tensors.values():
            tensor.requires_grad_(True)
        self.steps = 0
        self.first, self.second = (
            {name: torch.zeros_like(tensor.detach()) for name, tensor in self.tensors.items()}
            for _ in range(2)
        )

    def __len__(self) -> int:
        return int(self.tensors["means"].shape[0])

    @property
    def device(self) -> torch.device:
        """Device of the splats and of Adam's moments."""
        return self.tensors["means"].device

    def gaussians(
        self, tensors: dict[str, Tensor] | None = None, sh_degree: int | None = None
    ) -> Gaussians:
        """Build the splats, differentiable in the leaves, or from ``tensors`` in their place.

        Args:
            sh_degree: degree of the harmonics; all by default. Others cost a gradient of zeros.
        """
        t = self.tensors if tensors is None else tensors
        rest = t["rest"] if sh_degree is None else t["rest"][:, : (sh_degree + 1) ** 2 - 1]
        return Gaussians(
            self.settings.kind,
            t["means"],
            t["quats"],
            t["scales"].exp(),
            t["opacity"].sigmoid(),
            torch.cat([t["dc"], rest], dim=1) if rest.shape[1] else t["dc"],
            origin=self.origin,
            antialiased=self.antialiased,
            screen_filter=self.screen_filter,
            far=self.far,
        )

    def background(self, choice: str, random: torch.Generator | None) -> Tensor:
        """Return the (3,) colour behind the splats: "white", "black", or "random", if drawn."""
        if choice == "random" and random is not None:
            return torch.rand(3, generator=random, dtype=torch.float32).to(self.device)
        value = 1.0 if choice == "white" else 0.0
        return torch.full((3,), value, dtype=torch.float32, device=self.device)

    def keep_above(self, up: np.ndarray, height: float) -> None:
        """Keep sky splats from sinking below a height along ``up``, (3,), or the lowest of them.

        Args:
            height: in world coordinates, such as that of the highest camera: no camera then sees
                the sky below its horizon.
        """
        means = self.tensors["means"].detach()
        direction = torch.tensor(up, dtype=torch.float32, device=self.device)
        sky = means[means.norm(dim=1) > self.far] @ direction
        self.floor = direction, min([height - float(up @ self.origin), *sky.tolist()])

    def _clamp(self) -> None:
        largest = torch.tensor(math.log(LARGEST * self.extent), device=self.device)
        if math.isfinite(self.far):
            sky = self.tensors["means"].norm(dim=1, keepdim=True) > self.far
            largest = torch.where(sky, math.log(LARGEST_SKY * self.far), largest)
            if self.floor is not None:
                up, height = self.floor
                low = (height - self.tensors["means"] @ up).clamp_min(0)[:, None]
                self.tensors["means"].add_(torch.where(sky, low * up, 0.0))
        self.tensors["scales"].clamp_(math.log(SMALLEST * self.extent)).clamp_(max=largest)

    def step(self, progress: float) -> None:
        """Take one Adam step along the leaves' gradients, then clear the gradients.

        Args:
            progress: completed share of the fit, in [0, 1]; determines the learning rate of the
                centres.
        """
        s = self.settings
        if s.lr_means > 0 and s.lr_means_final > 0:
            rate = math.exp(
                (1 - progress) * math.log(s.lr_means) + progress * math.log(s.lr_means_final)
            )
        else:
            rate = (1 - progress) * s.lr_means + progress * s.lr_means_final
        self.rates["means"] = rate * self.extent
        for name, tensor in self.tensors.items():
            if tensor.grad is None or tensor.numel() == 0:
                continue
            adam_step(tensor, self.first[name], self.second[name], self.steps, self.rates[name])
        self.steps += 1
        with torch.no_grad():
            if s.lr_scales:
                self._clamp()
            self.tensors["opacity"].clamp_(-LARGEST_LOGIT, LARGEST_LOGIT)

    def replace(self, keep: Tensor, added: dict[str, Tensor]) -> None:
        """Keep the splats at the index ``keep`` with their Adam moments, and append ``added`` with
        zero moments.
        """
        for name in NAMES:
            self.tensors[name] = torch.cat(
                [self.tensors[name].detach()[keep], added[name]]
            ).requires_grad_(True)
            for moment in (self.first, self.second):
                moment[name] = torch.cat([moment[name][keep], torch.zeros_like(added[name])])

    def lower_opacity(self, limit: float) -> None:
        """Lower every opacity to at most ``limit``, and reset Adam's moments of opacity."""
        with torch.no_grad():
            self.tensors["opacity"].clamp_(max=math.log(limit / (1 - limit)))
        self.first["opacity"].zero_()
        self.second["opacity"].zero_()

    def clear(self) -> None:
        """Clear the gradients."""
        for tensor in self.tensors.values():
            tensor.grad = None

    def snapshot(self) -> dict[str, Tensor]:
        """Copy the leaves, by name."""
        return {name: tensor.detach().clone() for name, tensor in self.tensors.items()}

    def state(self) -> dict[str, Any]:
        """Collect the state that the next step depends on, in main memory."""
        parts = {"tensors": self.tensors, "first": self.first, "second": self.second}
        return {
            "steps": self.steps,
            "origin": [float(v) for v in self.origin],
            **{
                part: {name: tensor.detach().cpu().clone() for name, tensor in tensors.items()}
                for part, tensors in parts.items()
            },
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state`."""
        origin = np.array(state["origin"], dtype=np.float64)
        check.shape(origin, (3,), "origin")
        self.steps, self.origin = int(state["steps"]), origin
        device = self.device
        for name in NAMES:
            tensor = state["tensors"][name].to(device, copy=True)
            self.tensors[name] = tensor.requires_grad_(True)
            self.first[name] = state["first"][name].to(device, copy=True)
            self.second[name] = state["second"][name].to(device, copy=True)
