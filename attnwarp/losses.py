"""Losses of a fit: differences of pictures, and regularisers of the surface described by the
splats.

Pictures are H x W x C, sRGB in [0, 1]. Every loss is a mean over pixels, so that its weight does
not depend on the image's size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.render import Render

Tensor = torch.Tensor

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
"""Window of Wang et al. 2004: 11 x 11 pixels, Gaussian with sigma 1.5."""

SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
"""Stabilising constants of SSIM, for values in [0, 1]."""


def l1(image: check.Array, target: check.Array) -> Tensor:
    """Compute the mean absolute difference of two pictures, over pixels and channels.

    Args:
        image, target: (H, W, C) pictures of one shape, of any range.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> import torch
        >>> l1(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.25))
        tensor(0.2500)
    """
    image, target = _same(image, target)
    return (image - target).abs().mean()


def psnr(image: check.Array, target: check.Array) -> float:
    """Compute the peak signal-to-noise ratio in dB, -10 log10 of the mean squared error in float64;
    infinite for equal pictures.

    Args:
        image, target: (H, W, C) pictures of one shape, in [0, 1].

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> import torch
        >>> psnr(torch.zeros(1, 1, 3), torch.full((1, 1, 3), 0.5)) - 20 * math.log10(2)
        0.0
    """
    image, target = _same(image, target)
    error = float((image.detach().double() - target.detach().double()).square().mean())
    return psnr_of_mse(error)


def psnr_of_mse(error: float) -> float:
    """Compute -10 log10 of a mean squared error of values in [0, 1]; infinite for 0, NaN for NaN.

    To average views, average the error.

    Example:
        >>> psnr_of_mse(0.001), psnr_of_mse(0.0)
        (30.0, inf)
    """
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: check.Array, target: check.Array) -> Tensor:
    """Compute the mean structural similarity (Wang et al. 2004) of two (H, W, C) pictures in [0,
    1]; 1 for equal pictures.

    The mean covers channels and all windows completely inside the picture, as in the authors' code
    and in scikit-image's ``structural_similarity(gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False)``. The code of 3DGS pads with zeros instead, so it also scores
    windows that are partly outside. The result is differentiable in both.

    Args:
        image, target: pictures of one shape, at least 11 x 11 pixels, float32 or float64.

    Raises:
        ValueError: the shapes differ, the type is not supported, or a picture is smaller than the
            window.

    Example:
        >>> import torch
        >>> picture = torch.rand(16, 16, 3)
        >>> bool(ssim(picture, picture) > 0.999999)
        True
    """
    return ssim_map(image, target).mean()


def ssim_map(image: check.Array, target: check.Array) -> Tensor:
    """Compute the structural similarity of each window, (H - 10, W - 10, C), a mean of which is
    :func:`ssim`; arguments and errors are the same.

    Example:
        >>> import torch
        >>> picture = torch.rand(16, 12, 3)
        >>> ssim_map(picture, picture).shape  # one value a window
        torch.Size([6, 2, 3])
    """
    image, target = _windowed(image, target)
    result: Tensor = _Ssim.apply(image, target)
    return result


def ssim_terms(image: check.Array, target: check.Array) -> tuple[Tensor, Tensor]:
    """Compute the two factors of :func:`ssim_map`, weighted separately in MS-SSIM: luminance, and
    contrast and structure; two tensors of its shape without gradients.

    Example:
        >>> import torch
        >>> black, white = torch.zeros(11, 11, 3), torch.ones(11, 11, 3)
        >>> luminance, structure = ssim_terms(black, white)
        >>> luminance.max().item() < 1e-3, bool((structure > 0.99).all())  # both are flat
        (True, True)
    """
    image, target = _windowed(image, target)
    _, _, a1, a2, b1, b2 = _moments(image.detach(), target.detach())
    return a1 / b1, a2 / b2


def check_sizes(cameras: Sequence[Camera], smallest: int, loss: str, setting: str) -> None:
    """Raise ValueError, naming the first such view, if a view is too small for a loss.

    Example:
        >>> import numpy as np
        >>> from attnwarp import Camera, losses
        >>> camera = Camera(np.eye(3), np.eye(4), width=16, height=8, name="a.png")
        >>> losses.check_sizes([camera], losses.SSIM_WINDOW, "SSIM", "ssim")
        Traceback (most recent call last):
        ValueError: views: 'a.png' has 16 x 8 px, SSIM needs 11 a side; enlarge it, or set ssim to 0
    """
    for camera in cameras:
        if min(camera.height, camera.width) < smallest:
            raise ValueError(
                f"views: {camera.name!r} has {camera.width} x {camera.height} px, {loss} needs"
                f" {smallest} a side; enlarge it, or set {setting} to 0"
            )


def _windowed(image: check.Array, target: check.Array) -> tuple[Tensor, Tensor]:
    """Check that SSIM is defined for two pictures, and convert them to tensors."""
    image, target = _same(image, target)
    if image.ndim != 3:
        raise ValueError(f"image: got shape {tuple(image.shape)}, expected (H, W, C)")
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(
            f"image: got {image.shape[1]} x {image.shape[0]} px; SSIM is undefined below"
            f" {SSIM_WINDOW} x {SSIM_WINDOW}"
        )
    for name, picture in (("image", image), ("target", target)):
        if picture.dtype not in (torch.float32, torch.float64):
            raise ValueError(
                f"{name}: got {picture.dtype}, expected float32 or float64; convert it to values in"
                " [0, 1]"
            )
    return image, target


def _moments(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compute mu_x, mu_y and a1, a2, b1, b2 of similarity = a1 a2 / (b1 b2), for each window."""
    mu_x, mu_y = _blur(x), _blur(y)
    var_x = _blur(x * x) - mu_x * mu_x
    var_y = _blur(y * y) - mu_y * mu_y
    cov = _blur(x * y) - mu_x * mu_y
    a1, a2 = 2 * mu_x * mu_y + SSIM_C1, 2 * cov + SSIM_C2
    b1, b2 = mu_x * mu_x + mu_y * mu_y + SSIM_C1, var_x + var_y + SSIM_C2
    return mu_x, mu_y, a1, a2, b1, b2


class _Ssim(torch.autograd.Function):
    """SSIM with an explicit backward pass: eight blurs instead of ten, and few memory passes.

    With mu = blur(x), e = blur(x^2), e12 = blur(x y) the similarity is a function of the five
    blurred images, and the blur is its own adjoint: dx = blur(dmu) + 2 x blur(de) + y blur(de12).
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        mu_x, mu_y, a1, a2, b1, b2 = _moments(image.detach(), target.detach())
        similarity = a1 * a2 / (b1 * b2)
        ctx.save_for_backward(image, target, mu_x, mu_y, a1, a2, b1, b2, similarity)
        return similarity

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        x, y, mu_x, mu_y, a1, a2, b1, b2, similarity = ctx.saved_tensors
        share = upstream / (b1 * b2)
        d_cross = _spread(2 * a1 * share)
        d_square = _spread(-upstream * similarity / b2)
        common = 2 * (a2 - a1) * share
        unlike = 2 * upstream * similarity * (1 / b1 - 1 / b2)
        grads: list[Tensor | None] = [None, None]
        for k, (own, other, mu_own, mu_other) in enumerate(
            ((x, y, mu_x, mu_y), (y, x, mu_y, mu_x))
        ):
            if ctx.needs_input_grad[k]:
                d_mean = _spread(common * mu_other - unlike * mu_own)
                grads[k] = d_mean + 2 * own * d_square + other * d_cross
        return grads[0], grads[1]


@cache
def _kernel() -> npt.NDArray[np.float64]:
    x = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    weights = np.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    normalised: npt.NDArray[np.float64] = weights / weights.sum()
    return normalised


def _filter(values: Tensor) -> Tensor:
    """Blur (H, W, C) by a Gaussian, zeros outside. OpenCV's filter is 10 times as fast as a torch
    convolution on a CPU.
    """
    if values.device.type != "cpu":
        return _convolved(values)
    import cv2

    array = np.ascontiguousarray(values.numpy())
    blurred = cv2.sepFilter2D(array, -1, _kernel(), _kernel(), borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(blurred.reshape(array.shape))


def _convolved(values: Tensor) -> Tensor:
    """Compute :func:`_filter` by two convolutions, without a copy to main memory."""
    weights = torch.tensor(_kernel(), dtype=values.dtype, device=values.device).reshape(1, 1, -1, 1)
    # Full float32, since cuDNN defaults to TF32 with 10 bits.
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        rows = torch.nn.functional.conv2d(values.permute(2, 0, 1)[:, None], weights, padding="same")
        both = torch.nn.functional.conv2d(rows, weights.transpose(2, 3), padding="same")
    return both[:, 0].permute(1, 2, 0)


def _blur(values: Tensor) -> Tensor:
    """Compute weighted means over the windows inside the picture, (H - 10, W - 10, C)."""
    edge = SSIM_WINDOW // 2
    return _filter(values)[edge:-edge, edge:-edge]


def _spread(values: Tensor) -> Tensor:
    """Apply the adjoint of :func:`_blur`: (H - 10, W - 10, C) to (H, W, C)."""
    edge = SSIM_WINDOW // 2
    return _filter(torch.nn.functional.pad(values, (0, 0, edge, edge, edge, edge)))


def normal_consistency(view: Render) -> Tensor:
    """Average sum_i w_i (1 - n_i . N) over pixels, N the normal of the rendered depth (2DGS).

    The sum equals alpha - (sum_i w_i n_i) . N. Pixels with undefined N (the image's border, edges
    of the drawn surface) count as 0. Gradients flow through both normals. Source: Huang et
    al. 2024 (2DGS).

    Args:
        view: rendered view.

    Example:
        >>> from attnwarp.render import render
        >>> from attnwarp.trial import disc, view
        >>> normal_consistency(render(disc(), view())).item() < 1e-5  # a disc is flat
        True
    """
    if view.backend == "cpu" and not view._pose.requires_grad:
        # Imported here, since numba is slow to import.
        from attnwarp.render import consistency

        pose = view._pose[:3, :3]
        return consistency.normal_consistency(
            view.depth, view.alpha, view.normal, view.camera, pose
        )
    N = view.normal_from_depth
    defined = torch.isfinite(N.detach()).all(-1)
    agreement = (view.normal * torch.where(defined[..., None], N, 0.0)).sum(-1)
    return torch.where(defined, view.alpha - agreement, 0.0).mean()


def depth_distortion(view: Render, *, scale: float = 1.0) -> Tensor:
    """Average over pixels the depth spread of the splats along a ray: 2 sum_i w_i |sum_{j<i} w_j
    (z_i - z_j)|, j composited before i, which is sum_ij w_i w_j |z_i - z_j| (the 2DGS paper), or
    less where splats intersect.

    Args:
        view: rendered view.
        scale: length in scene units by which it is divided, so that its weight does not depend on
            the scene's unit.

    Example:
        >>> from attnwarp.render import render
        >>> from attnwarp.trial import disc, view
        >>> depth_distortion(render(disc(), view())).item()  # one splat has no spread
        0.0
    """
    return view.distortion_ordered.mean() / scale


def _same(image: check.Array, target: check.Array) -> tuple[Tensor, Tensor]:
    """Check that two pictures have one shape, and convert them to tensors."""
    image, target = check.tensor(image, "image"), check.tensor(target, "target")
    if image.shape != target.shape:
        raise ValueError(
            f"target: got shape {tuple(target.shape)}, expected that of image, {tuple(image.shape)}"
        )
    return image, target
