"""What is optimised: the splats as free numbers, and Adam's memory of each."""

from __future__ import annotations

import math
from typing import Any

import torch

from attnwarp.fit.settings import FitSettings
from attnwarp.gaussians import Gaussians

Tensor = torch.Tensor

NAMES = ("means", "dc", "rest", "opacity", "scales", "quats")

SMALLEST, LARGEST = 1e-7, 1e3
"""Scales stay within these shares of the extent: beyond, they would leave float32 and show nothing."""

LARGEST_LOGIT = 15.0
"""Opacity stays within sigmoid(+-15), 3e-7 from 0 and 1, where its gradient can still bring it back in float32."""


class Model:
    """Splats as Adam sees them: centres, harmonics, logit of opacity, logarithm of scales, quaternions.

    Attributes:
        tensors: the leaves by name: "means" (N, 3), "dc" (N, 1, 3), "rest" (N, K - 1, 3), "opacity" (N,) logits,
            "scales" (N, 2 or 3) logarithms, "quats" (N, 4).
        extent: of the scene, in its units.
    """

    def __init__(self, start: Gaussians, settings: FitSettings, extent: float) -> None:
        self.settings, self.extent = settings, extent
        self.origin, self.antialiased = start.origin, settings.antialiased
        g = start.detach().to(dtype=torch.float32)
        self.tensors: dict[str, Tensor] = {
            "means": g.means.clone(),
            "dc": g.sh[:, :1].clone(),
            "rest": g.sh[:, 1:].clone(),
            "opacity": torch.logit(g.opacities, eps=1e-6),
            "scales": g.scales.log(),
            "quats": g.quats.clone(),
        }
        rates = {
            "means": settings.lr_means * extent,
            "dc": settings.lr_dc,
            "rest": settings.lr_rest,
            "opacity": settings.lr_opacity,
            "scales": settings.lr_scales,
            "quats": settings.lr_quats,
        }
        for tensor in self.tensors.values():
            tensor.requires_grad_(True)
        # eps: gradients of a mean over pixels are tiny, and Adam must not take them for noise (3DGS).
        self.adam = torch.optim.Adam(
            [{"params": [self.tensors[name]], "lr": rates[name], "name": name} for name in NAMES],
            eps=1e-15,
            fused=True,
        )

    def __len__(self) -> int:
        return int(self.tensors["means"].shape[0])

    def gaussians(self) -> Gaussians:
        """The splats, differentiable in the leaves."""
        t = self.tensors
        return Gaussians(
            self.settings.kind,
            t["means"],
            t["quats"],
            t["scales"].exp(),
            t["opacity"].sigmoid(),
            torch.cat([t["dc"], t["rest"]], dim=1),
            origin=self.origin,
            antialiased=self.antialiased,
        )

    def step(self, progress: float) -> None:
        """One step of Adam along the leaves' gradients, which are then dropped.

        Args:
            progress: share of the fit that is done, in [0, 1]; decides the learning rate of the centres.
        """
        s = self.settings
        if s.lr_means > 0 and s.lr_means_final > 0:
            rate = math.exp((1 - progress) * math.log(s.lr_means) + progress * math.log(s.lr_means_final))
        else:
            rate = (1 - progress) * s.lr_means + progress * s.lr_means_final
        self.adam.param_groups[NAMES.index("means")]["lr"] = rate * self.extent
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        with torch.no_grad():
            self.tensors["scales"].clamp_(math.log(SMALLEST * self.extent), math.log(LARGEST * self.extent))
            self.tensors["opacity"].clamp_(-LARGEST_LOGIT, LARGEST_LOGIT)

    def replace(self, keep: Tensor, added: dict[str, Tensor]) -> None:
        """Keep the splats at the index ``keep`` with Adam's memory of them, and append ``added``, which have none."""
        for group, name in zip(self.adam.param_groups, NAMES, strict=True):
            old = self.tensors[name]
            new = torch.cat([old.detach()[keep], added[name]]).requires_grad_(True)
            state = self.adam.state.pop(old, {})
            for key, value in state.items():
                if key != "step":
                    fresh = torch.zeros_like(new.detach()[len(keep) :])
                    state[key] = torch.cat([value[keep], fresh])
            self.adam.state[new] = state
            group["params"] = [new]
            self.tensors[name] = new

    def lower_opacity(self, limit: float) -> None:
        """Bring every opacity down to at most ``limit``, and forget where Adam was taking them."""
        opacity = self.tensors["opacity"]
        with torch.no_grad():
            opacity.clamp_(max=math.log(limit / (1 - limit)))
        for key, value in self.adam.state[opacity].items():
            if key != "step":
                value.zero_()

    def state(self) -> dict[str, Any]:
        """Everything that the next step depends on."""
        return {
            "tensors": {name: tensor.detach().clone() for name, tensor in self.tensors.items()},
            "adam": [
                {key: value.clone() for key, value in self.adam.state[self.tensors[name]].items()} for name in NAMES
            ],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what :meth:`state` gave."""
        for group, name, memory in zip(self.adam.param_groups, NAMES, state["adam"], strict=True):
            self.adam.state.pop(self.tensors[name], None)
            tensor = state["tensors"][name].clone().requires_grad_(True)
            group["params"], self.tensors[name] = [tensor], tensor
            self.adam.state[tensor] = {key: value.clone() for key, value in memory.items()}
