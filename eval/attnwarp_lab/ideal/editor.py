"""The ideal editor: the exact posterior mean over all answers, computed by attention that can be
recorded and injected.

Tokens i of f x f px are the pixel-unshuffle of 2 picture - 1, which is orthonormal, so that parts
factorise. z_0 is the picture before, z_k the true picture of answer k, D_ki = z_ki - z_0i, p(i) the
part of a token, a alpha-bar of the step:

evidence         l_ik = (sqrt(a) <x_i - sqrt(a) z_0i, D_ki> - (a / 2) |D_ki|^2) / (1 - a)
self-attention   s_i = mean of l_j over the tokens j of part p(i), centred over k
posterior        w_i = softmax_k(N_p(i) s_i)
cross-attention  u_i = sum_k w_ik D_ki ("paint"), or w_i, applied behind the hook ("word")
prediction       x_0i = z_0i + u_i

Without injection that is the mean over all K^P pictures, P parts of K answers each, given the noisy
one: the log-likelihood of a picture is the sum of its tokens' l, and tokens of different parts are
independent.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from attnwarp.editing.editor import Defaults, Guide, Image, tensor_of
from attnwarp.editing.layers import Call, Kind, Layer, unet_call
from attnwarp.editing.schedule import DDIM, Size, Time, stable_diffusion_alphas

FACTOR = 4
"""Pixels along the side of a token, as of the bundled editors."""

Cross = Literal["paint", "word", "swapped"]


@dataclass(frozen=True, eq=False)
class Answers:
    """True pictures of one view.

    Attributes:
        before: (H, W, 3) sRGB in [0, 1] before the edit.
        after: (K, H, W, 3) after the edit, the whole thing in one answer.
        parts: (h, w) part of each token, -1 outside the thing.
    """

    before: Image
    after: npt.NDArray[np.float32]
    parts: npt.NDArray[Any]


class Output(torch.nn.Module):
    """The output of an attention layer, where hooks read and replace it."""

    def forward(self, features: Tensor) -> Tensor:
        """Return (B, n, C) features unchanged."""
        return features


class IdealUNet(torch.nn.Module):
    """The network.

    Args:
        views: views of one size, with the same number of answers.
        alphas: (N,) alpha-bar of the steps.
        cross: output of cross-attention, "paint" or "word"; "swapped" calls the layer that paints
            self-attention and the other one cross-attention.
    """

    before: Tensor
    change: Tensor
    parts: Tensor
    members: Tensor
    energy: Tensor
    alphas: Tensor

    def __init__(self, views: Sequence[Answers], alphas: Tensor, cross: Cross = "paint") -> None:
        super().__init__()
        before = torch.stack([tokens_of(_picture(view.before)) for view in views])
        after = torch.stack(
            [torch.stack([tokens_of(_picture(one)) for one in view.after]) for view in views]
        )
        self.cross: Cross = cross
        # Buffers, so that a digest of the network includes its answers.
        self.register_buffer("before", before)  # (V, n, C)
        self.register_buffer("change", after - before[:, None])  # (V, K, n, C)
        parts = torch.stack([torch.from_numpy(np.asarray(v.parts)).flatten() for v in views]).long()
        self.register_buffer("parts", parts)  # (V, n)
        self.register_buffer("members", _members(parts))  # (V, n) tokens of the token's part
        self.register_buffer("energy", self.change.square().sum(dim=-1))  # (V, K, n)
        self.register_buffer("alphas", alphas)
        self.self_attention, self.cross_attention = Output(), Output()
        self.size = int(views[0].parts.shape[0]), int(views[0].parts.shape[1])

    @property
    def device(self) -> torch.device:
        """Device of the answers."""
        return self.before.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of the answers."""
        return self.before.dtype

    def forward(self, sample: Tensor, timestep: Any, views: Sequence[int]) -> Tensor:
        """Predict the clean latents of noisy ones.

        Args:
            sample: (B, C, h, w) latents at the step.
            timestep: timestep of the schedule.
            views: number of each row's view.

        Returns:
            (B, C, h, w).
        """
        rows = list(views)
        x = sample.flatten(2).transpose(1, 2)  # (B, n, C)
        evidence = self.evidence(x, int(timestep), rows)
        s = self.self_attention(part_means(evidence, self.parts[rows]))
        w = torch.softmax(self.members[rows][..., None] * s, dim=-1)  # (B, n, K)
        inside = (self.parts[rows] >= 0)[..., None]
        if self.cross == "word":
            w = self.cross_attention(torch.where(inside, w, 0.0))
        u = torch.einsum("bnk,bknc->bnc", w, self.change[rows])
        u = torch.where(inside, u, 0.0)
        if self.cross != "word":
            u = self.cross_attention(u)
        clean = self.before[rows] + u
        return clean.transpose(1, 2).unflatten(2, sample.shape[2:])

    def evidence(self, x: Tensor, timestep: int, views: Sequence[int]) -> Tensor:
        """(B, n, K) log-likelihood of each answer in each token, centred over the answers.

        Args:
            x: (B, n, C) noisy tokens.
            timestep: timestep of the schedule.
            views: number of each row's view.
        """
        a = self.alphas[timestep].to(x)
        rest = x - a.sqrt() * self.before[views]
        fit = torch.einsum("bnc,bknc->bnk", rest, self.change[views])

        evidence = (a.sqrt() * fit - a / 2 * self.energy[views].transpose(1, 2)) / (1 - a)
        return evidence - evidence.mean(dim=-1, keepdim=True)


def part_means(values: Tensor, parts: Tensor) -> Tensor:
    """(B, n, K) means of values over the tokens of each token's part; 0 outside the thing.

    Softmax attention whose queries and keys are the parts' one-hot codes, scaled without bound.

    Args:
        values: (B, n, K).
        parts: (B, n), -1 for none.

    Example:
        >>> import torch
        >>> parts = torch.tensor([[0, 0, 1, -1]])
        >>> part_means(torch.tensor([[[1.0], [3.0], [5.0], [7.0]]]), parts)[0, :, 0].tolist()
        [2.0, 2.0, 5.0, 0.0]
    """
    count = int(parts.max()) + 2
    index = (parts + 1)[..., None].expand_as(values)
    sums = values.new_zeros(len(values), count, values.shape[-1]).scatter_add(1, index, values)
    means = sums / _counts(parts, count).clamp_min(1)[..., None].to(values)
    return torch.where((parts >= 0)[..., None], means.gather(1, index), 0.0)


def _counts(parts: Tensor, count: int) -> Tensor:
    """(B, count) number of tokens of each part, starting with tokens of no part."""
    ones = torch.ones_like(parts)
    return torch.zeros(len(parts), count, dtype=parts.dtype).scatter_add(1, parts + 1, ones)


def _members(parts: Tensor) -> Tensor:
    """(V, n) tokens of each token's part; 0 outside the thing."""
    counts = _counts(parts, int(parts.max()) + 2)
    return torch.where(parts >= 0, counts.gather(1, parts + 1), 0).float()


def _picture(image: Image) -> Tensor:
    """(1, 3, H, W) of an (H, W, 3) picture."""
    return torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32)).permute(2, 0, 1)[None]


def tokens_of(picture: Tensor) -> Tensor:
    """(n, C) tokens of a (1, 3, H, W) picture in [0, 1]."""
    return pixel_unshuffle(2 * picture - 1, FACTOR)[0].flatten(1).T.contiguous()


def schedule(share: float = 1.0) -> DDIM:
    """Noise schedule of the ideal editor: Stable Diffusion's, whose last step is pure noise (Lin
    et al. 2024, algorithm 1), with its signal scaled.

    Args:
        share: factor of the signal-to-noise ratio a / (1 - a) at every step, above 0.

    Raises:
        ValueError: no such factor.

    Example:
        >>> float(schedule().alphas[-1]), float(schedule(0.25).alphas[0] < schedule().alphas[0])
        (0.0, 1.0)
    """
    if not share > 0:
        raise ValueError(f"share: got {share!r}, expected a number above 0")
    roots = stable_diffusion_alphas().sqrt()
    first, last = roots[0], roots[-1]
    a = ((roots - last) * first / (first - last)).square()
    return DDIM((share * a / (share * a + 1 - a)).float(), "sample", 1.0)


class IdealEditor(Defaults):
    """An :class:`~attnwarp.editing.editor.Editor` with the answers of every view.

    Args:
        views: by name.
        share: share of the schedule's signal, see :func:`schedule`.
        cross: output of cross-attention.
    """

    guide: Guide = "picture"
    branches: tuple[str, ...] = ("text",)
    carries: tuple[str, ...] = ("text",)
    options: tuple[str, ...] = ()
    side_multiple = FACTOR

    def __init__(
        self, views: Sequence[Answers], share: float = 1.0, cross: Cross = "paint"
    ) -> None:
        self.schedule = schedule(share)
        self.unet = IdealUNet(views, self.schedule.alphas, cross)
        self._numbers = {_key(view.before): number for number, view in enumerate(views)}

    @property
    def network(self) -> IdealUNet:
        """The network."""
        return self.unet

    @property
    def parts(self) -> dict[str, Any]:
        """The network; there is no text encoder."""
        return {"unet": self.unet}

    @property
    def own_size(self) -> int:
        """Longest side in px of the views."""
        return FACTOR * max(self.unet.size)

    def layers(self) -> tuple[Layer, ...]:
        """The two layers of attention."""
        count, channels = self.unet.change.shape[1], self.unet.change.shape[-1]
        kinds: list[Kind] = ["self", "cross"]
        choice, paint = reversed(kinds) if self.unet.cross == "swapped" else kinds
        return (
            Layer("self_attention", choice, 0, count),
            Layer("cross_attention", paint, 0, count if self.unet.cross == "word" else channels),
        )

    def call(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Call:
        """The pass of a network call."""
        return unet_call(self.branches, args, kwargs)

    def noise_shape(self, size: Size) -> tuple[int, int, int]:
        """(C, h, w) of the latents of an (H, W) px view."""
        return 3 * FACTOR**2, size[0] // FACTOR, size[1] // FACTOR

    def check_text(self, text: str) -> None:
        """Accept any words: only the answers matter."""

    def task(
        self,
        guides: Sequence[npt.NDArray[Any]],
        prompt: str,
        regions: Sequence[npt.NDArray[Any]] | None = None,
    ) -> IdealTask:
        """Edit of the views with the given original pictures.

        Raises:
            ValueError: a picture of no view.
        """
        tensor_of(guides, "guides", FACTOR)
        numbers = [self._numbers.get(_key(guide)) for guide in guides]
        if None in numbers:
            raise ValueError(
                "guides: got a picture that is no view's before the edit; the ideal editor knows"
                " the answers of those views alone, at their own size"
            )
        return IdealTask(self, [n for n in numbers if n is not None])

    def encode(self, pictures: Sequence[Image]) -> Tensor:
        """(B, C, h, w) latents of (H, W, 3) pictures in [0, 1]."""
        return self.latents(tensor_of(pictures, "pictures", FACTOR))

    def latents(self, pixels: Tensor) -> Tensor:
        """(B, C, h, w) latents of (B, 3, H, W) pixels."""
        return pixel_unshuffle(2 * pixels - 1, FACTOR)

    def pixels(self, latents: Tensor) -> Tensor:
        """(B, 3, H, W) of latents."""
        return pixel_shuffle(latents, FACTOR) / 2 + 0.5

    def decode(self, latents: Tensor) -> list[Image]:
        """(H, W, 3) pictures in [0, 1] of latents."""
        return list(self.pixels(latents).clamp(0, 1).permute(0, 2, 3, 1).cpu().numpy())


@dataclass(frozen=True, eq=False)
class IdealTask:
    """An edit of some views.

    Attributes:
        editor: editor with the network.
        views: numbers of the views.
    """

    editor: IdealEditor
    views: Sequence[int]

    @property
    def branches(self) -> tuple[str, ...]:
        """The only branch."""
        return self.editor.branches

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(B, C, h, w) of the latents."""
        return len(self.views), self.editor.unet.before.shape[-1], *self.editor.unet.size

    def predict(self, latents: Tensor, timestep: Time) -> Tensor:
        """(B, C, h, w) clean latents, predicted at a step."""
        result: Tensor = self.editor.unet(latents, timestep, views=self.views)
        return result


def _key(picture: npt.NDArray[Any]) -> str:
    """Hash of a picture's values."""
    return hashlib.sha256(np.ascontiguousarray(picture, dtype=np.float32).tobytes()).hexdigest()
