"""LPIPS from local weights: a torchvision backbone (AlexNet or VGG16) and the published
linear layers.

The networks are defined here, with torchvision's names of tensors, so torchvision need not be
installed.

Source: R. Zhang, P. Isola, A. A. Efros, E. Shechtman, O. Wang, "The Unreasonable Effectiveness of
Deep Features as a Perceptual Metric", CVPR 2018, and its released weights, version 0.1.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from attnwarp.devices import device_of
from attnwarp.encoders._weights import full_float32, sha256_of, state_of
from attnwarp.encoders.base import EncoderInfo, Image, checked_pairs
from attnwarp.errors import InputError
from attnwarp.io.file import visible

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""The published scaling layer: (x - shift) / scale of x in [-1, 1], which is ImageNet's
normalisation.
"""

EPSILON = 1e-10
"""Added to a feature's norm before dividing, as published; it matters if no channel responds."""

SUFFIXES = (".pth", ".pt", ".bin", ".safetensors")


@dataclass(frozen=True)
class Backbone:
    """Backbone network, one of two.

    Attributes:
        name: name in LPIPS.
        file: file of the weights in torchvision.
        taps: index of the last layer of each stage in torchvision's ``features``.
        channels: channel counts of each stage.
        smallest: shortest side in px for which a picture reaches the last stage.
    """

    name: str
    file: str
    taps: tuple[int, ...]
    channels: tuple[int, ...]
    smallest: int


BACKBONES = {
    b.name: b
    for b in (
        Backbone(
            "alex", "alexnet-owt-7be5be79.pth", (1, 4, 7, 9, 11), (64, 192, 384, 256, 256), 31
        ),
        Backbone("vgg", "vgg16-397923af.pth", (3, 8, 15, 22, 29), (64, 128, 256, 512, 512), 16),
    )
}


def features(name: str) -> nn.Sequential:
    """Build torchvision's ``features`` of a network up to LPIPS's last stage; its tensors are named
    like torchvision's, ``0.weight``.
    """
    if name == "alex":
        layers: list[nn.Module] = [
            nn.Conv2d(3, 64, 11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, 2),
        ]
        layers += [nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
        for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
    elif name == "vgg":
        layers, inputs = [], 3
        for i, (outputs, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
            layers += [nn.MaxPool2d(2, 2)] if i else []
            for _ in range(count):
                layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
                inputs = outputs
    else:
        raise ValueError(f"name: got {name!r}, expected one of {', '.join(BACKBONES)}")
    return nn.Sequential(*layers)


class Lpips:
    """LPIPS distance; see :class:`attnwarp.encoders.PerceptualDistance`.

    Args:
        network: ``features`` of the backbone, see :func:`features`.
        weights: linear layers, one (channels,) tensor per stage.

    Attributes:
        smallest: shortest accepted side of a picture, px.
    """

    def __init__(
        self,
        backbone: Backbone,
        network: nn.Sequential,
        weights: Sequence[torch.Tensor],
        about: EncoderInfo,
        device: torch.device | str = "cpu",
    ) -> None:
        self.about = about
        self.smallest = backbone.smallest
        self._backbone = backbone
        self._device = torch.device(device)
        self._network = network.to(self._device, torch.float32).eval().requires_grad_(False)
        self._weights = [w.to(self._device, torch.float32).reshape(1, -1, 1, 1) for w in weights]

    def distance(self, a: Sequence[Image], b: Sequence[Image]) -> npt.NDArray[np.float64]:
        """Compute distances, (N,) float64; see :class:`attnwarp.encoders.PerceptualDistance`.

        Raises:
            ValueError: as there, or a picture is smaller than the network's limit.
        """
        pairs = checked_pairs(a, b)
        for i, (first, _) in enumerate(pairs):
            if min(first.shape[:2]) < self.smallest:
                raise ValueError(
                    f"a[{i}]: got {first.shape[1]} x {first.shape[0]} px, expected sides of at"
                    f" least {self.smallest} px for LPIPS with {self._backbone.name}"
                )
        # Pair by pair: VGG's first stage holds 64 floats a pixel, 134 MB for one pair of 512 x 512.
        return np.array([self._pair(first, second) for first, second in pairs], dtype=np.float64)

    def _pair(self, a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> float:
        if np.array_equal(a, b):
            return 0.0  # exactly 0: a kernel may sum the two halves of a batch in different orders
        with full_float32():
            both = self._units(torch.from_numpy(np.stack([a, b])).permute(0, 3, 1, 2))
            return float(sum(self._parts([x[0] for x in both], [x[1] for x in both])))

    def loss(self, image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Compute the distance () of two (H, W, 3) pictures in [0, 1], differentiable."""
        return self.between(self.features(image), self.features(target))

    def features(self, picture: torch.Tensor) -> list[torch.Tensor]:
        """Compute features of a picture (H, W, 3) for :meth:`between`, differentiable."""
        return [x[0] for x in self._units(picture.permute(2, 0, 1)[None])]

    def between(self, image: list[torch.Tensor], target: list[torch.Tensor]) -> torch.Tensor:
        """Compute the distance () of two pictures from their :meth:`features`."""
        return torch.stack(self._parts(image, target)).sum()

    def _units(self, pictures: torch.Tensor) -> list[torch.Tensor]:
        """Compute unit features of each stage, (N, C_k, h_k, w_k), of pictures (N, 3, H, W)."""
        shift, scale = (
            torch.tensor(v, dtype=torch.float32, device=self._device).reshape(1, 3, 1, 1)
            for v in (SHIFT, SCALE)
        )
        x = (2 * pictures.to(self._device) - 1 - shift) / scale
        units: list[torch.Tensor] = []
        for i, layer in enumerate(self._network):
            x = layer(x)
            if i == self._backbone.taps[len(units)]:
                units.append(x / (torch.linalg.vector_norm(x, dim=1, keepdim=True) + EPSILON))
        return units

    def _parts(self, a: list[torch.Tensor], b: list[torch.Tensor]) -> list[torch.Tensor]:
        """Compute each stage's distance, () float64, from two pictures' unit features."""
        return [
            (((x - y) ** 2)[None] * weight).sum(1).mean(dtype=torch.float64)
            for x, y, weight in zip(a, b, self._weights, strict=True)
        ]


def load_lpips(place: Path, *, name: str, device: str = "cpu") -> Lpips:
    """Load LPIPS from one complete file, or from a folder with a backbone and linear
    layers.

    Args:
        place: state dict saved from an LPIPS network (``net.slice1.0.weight``,
            ``lin0.model.1.weight``, ...), or a folder with torchvision's state dict of a backbone
            (``features.0.weight``, ...) and one or more published files of linear layers; the one
            that fits the backbone is used.
    """
    torch_device = device_of(device)
    if place.is_file():
        files = [place]
    elif place.is_dir():
        files = [p for p in visible(place.iterdir()) if p.suffix in SUFFIXES and p.is_file()]
    else:
        files = []
    if not files:
        raise InputError(f"{name}: {place} is no file and no folder with weights. {_HOW}")
    networks: list[tuple[Path, Backbone, dict[str, torch.Tensor]]] = []
    linears: list[tuple[Path, list[torch.Tensor]]] = []
    for path in files:
        state = state_of(path)
        layers = _backbone_tensors(state)
        matching = next((b for b in BACKBONES.values() if layers and _fits(b, layers)), None)
        if matching is not None:
            networks.append((path, matching, layers))
        if lines := _linear_tensors(state):
            linears.append((path, lines))
    if len(networks) != 1:
        count = (
            "no backbone"
            if not networks
            else "several backbones: " + ", ".join(p.name for p, _, _ in networks)
        )
        raise InputError(f"{name}: {place} holds {count}, expected one. {_HOW}")
    path, backbone, layers = networks[0]
    fitting = [(p, ws) for p, ws in linears if tuple(w.numel() for w in ws) == backbone.channels]
    if len(fitting) != 1:
        count = "no" if not fitting else "several files of"
        raise InputError(
            f"{name}: {place} holds {count} linear layers for {backbone.name}, expected one file."
            f" {_HOW}"
        )
    used = sorted({path, fitting[0][0]})
    if not all(bool(torch.isfinite(v).all()) for v in [*layers.values(), *fitting[0][1]]):
        raise InputError(f"{name}: weights in {place} are NaN or infinite; fetch the files again")
    with torch.device("meta"):  # skips random weights, which would be replaced at once
        network = features(backbone.name)
    network.load_state_dict(layers, assign=True)
    about = EncoderInfo(
        name=name,
        kind="perceptual",
        source=", ".join(str(p) for p in used),
        weights_sha256=sha256_of(used),
        preprocessing=(
            f"LPIPS 0.1 with {backbone.name}: [0, 1] to [-1, 1], minus {SHIFT}, over {SCALE}; not"
            " resized"
        ),
    )
    return Lpips(backbone, network, fitting[0][1], about, torch_device)


_HOW = (
    "Place there two files: the backbone's weights as torchvision publishes them ("
    + ", ".join(b.file for b in BACKBONES.values())
    + ") and the file of linear layers of the lpips package, version 0.1 (alex.pth or"
    " vgg.pth). Or name one file saved with torch.save(lpips.LPIPS(net='alex').state_dict(),"
    " FILE) on a machine that has that package"
)


def _backbone_tensors(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Select the backbone's tensors by torchvision's names without ``features.``, for both ways of
    saving.
    """
    # lpips numbers the layers inside its slices as torchvision does: net.slice3.6.weight is
    # features.6.weight.
    pattern = re.compile(r"(?:module\.)?(?:features|net\.slice\d+|net\.slices\.\d+)\.(\d+\..+)")
    return {m[1]: v for key, v in state.items() if (m := pattern.fullmatch(key))}


def _fits(backbone: Backbone, layers: dict[str, torch.Tensor]) -> bool:
    with torch.device("meta"):
        expected = {
            key: tuple(value.shape) for key, value in features(backbone.name).state_dict().items()
        }
    return expected == {key: tuple(value.shape) for key, value in layers.items()}


def _linear_tensors(state: dict[str, torch.Tensor]) -> list[torch.Tensor]:
    pattern = re.compile(r"(?:module\.)?lin(\d+)\.model\.\d+\.weight")
    weights = {
        int(m[1]): value.detach().flatten()
        for key, value in state.items()
        if (m := pattern.fullmatch(key))
    }
    return [weights[i] for i in sorted(weights)]
