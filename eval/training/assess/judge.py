"""Answer that an edited picture gives, and what it leaves alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from attnwarp.editing.editor import Image

Lab = npt.NDArray[np.float64]

Answer = Callable[[Image, str, int], Image]
"""The edited picture of a picture, an instruction and a seed."""


def mean_lab(image: Image, mask: npt.NDArray[np.bool_]) -> Lab:
    """(3,) CIELAB of the mean colour in a mask, averaged in linear light."""
    from skimage.color import rgb2lab

    from attnwarp_eval.colors import to_linear, to_srgb

    mean = to_linear(image[mask].astype(np.float64)).mean(axis=0)
    return np.asarray(rgb2lab(to_srgb(mean)[None, None])[0, 0])


def nearest(image: Image, answers: Sequence[Image], mask: npt.NDArray[np.bool_]) -> int:
    """Index of the picture that has the mean colour in the mask that is nearest to the picture's
    (CIEDE2000).
    """
    from skimage.color import deltaE_ciede2000

    own = mean_lab(image, mask)
    return int(np.argmin([deltaE_ciede2000(own, mean_lab(a, mask)) for a in answers]))


def outside_psnr(image: Image, before: Image, mask: npt.NDArray[np.bool_]) -> float:
    """dB between two pictures where the mask is not."""
    return float(-10 * np.log10(max(np.square(image[~mask] - before[~mask]).mean(), 1e-10)))
