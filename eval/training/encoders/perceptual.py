"""Recipe of perceptual-small: a distance of pictures that orders distortions by their strengths.

Features and channel weights are learned together, on photographs and renderings, from pairs of
distortions with a stronger one by construction (:mod:`training.encoders.distort`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from attnwarp.encoders.nets import PerceptualSmall
from training.common import Run, channels_last, descend, rate, settings
from training.encoders.distort import MARGIN, TRAIN_KINDS, distorted, draw_pair
from training.worlds.data import load

SEED = 3
EPOCHS = 6
STEPS = 200
BATCH = 16
SIZE = 64
PEAK = 2e-3

TRAIN_PHOTOS = (
    "astronaut.png", "coffee.png", "camera.png", "brick.png", "grass.png", "motorcycle_left.png", "moon.png", "ihc.png",
    "hubble_deep_field.jpg", "retina.jpg", "page.png", "text.png",
)  # fmt: skip
"""Files that scikit-image carries in its package; nothing is downloaded."""

Image = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sources:
    """Sources of crops: photographs of any size, and renderings."""

    photos: list[npt.NDArray[np.uint8]]
    renders: npt.NDArray[np.uint8]

    def crop(self, rng: np.random.Generator, size: int = SIZE) -> Image:
        """A random (size + 2 MARGIN) square crop, from a photograph as often as from a rendering,
        at a random scale.
        """
        pick = (
            self.photos[int(rng.integers(len(self.photos)))]
            if rng.uniform() < 0.5
            else self.renders[int(rng.integers(len(self.renders)))]
        )
        full = size + 2 * MARGIN
        h, w = pick.shape[:2]
        side = int(
            min(
                h,
                w,
                full
                * np.exp(
                    rng.uniform(0, np.log(max(1.0, min(h, w) / full) + 1e-9))
                    if min(h, w) > full
                    else 0.0
                ),
            )
        )
        y, x = int(rng.integers(h - side + 1)), int(rng.integers(w - side + 1))
        patch = pick[y : y + side, x : x + side].astype(np.float32) / 255
        if side != full:
            patch = cv2.resize(
                patch,
                (full, full),
                interpolation=cv2.INTER_AREA if side > full else cv2.INTER_CUBIC,
            )
        if rng.uniform() < 0.5:
            patch = patch[:, ::-1]
        return np.ascontiguousarray(np.clip(patch, 0, 1))


def photographs(names: tuple[str, ...]) -> list[npt.NDArray[np.uint8]]:
    """Photographs that scikit-image ships, (H, W, 3); grey ones in three equal channels."""
    import skimage.data

    folder = Path(skimage.data.__file__).parent
    images: list[npt.NDArray[np.uint8]] = []
    for name in names:
        image = cv2.imread(str(folder / name), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(f"{folder / name}: not in this scikit-image")
        images.append(np.ascontiguousarray(image[..., ::-1]).astype(np.uint8))
    return images


def triple(
    sources: Sources, rng: np.random.Generator, kinds: tuple[str, ...], **how: float
) -> tuple[Image, Image, Image, float, float]:
    """A picture, a weaker and a stronger distortion of it, and both strengths."""
    full = sources.crop(rng)
    (kind_a, a, seed_a), (kind_b, b, seed_b) = draw_pair(rng, kinds, **how)
    m = MARGIN
    return (
        full[m:-m, m:-m],
        distorted(full, kind_a, a, seed_a),
        distorted(full, kind_b, b, seed_b),
        a,
        b,
    )


def _batch(
    make: Callable[[], tuple[Image, Image, Image, float, float]], count: int
) -> tuple[torch.Tensor, ...]:
    rows = [make() for _ in range(count)]
    images = [
        torch.from_numpy(np.stack([r[k] for r in rows])).permute(0, 3, 1, 2) for k in range(3)
    ]
    strengths = torch.tensor([[r[3], r[4]] for r in rows], dtype=torch.float32)
    return (*images, strengths)


def train(data: Path, out: Path, *, epochs: int = EPOCHS) -> Path:
    """Train perceptual-small; the checkpoint's path."""
    torch.manual_seed(SEED)
    out.mkdir(parents=True, exist_ok=True)
    sources = Sources(photographs(TRAIN_PHOTOS), load(data, "train").images[::7])
    model = channels_last(PerceptualSmall())
    optimizer = torch.optim.AdamW(model.parameters(), lr=PEAK, weight_decay=1e-4)

    def epoch(number: int) -> dict[str, float]:
        rng = np.random.default_rng([SEED, number])
        total, right = 0.0, 0
        for step in range(STEPS):
            for group in optimizer.param_groups:
                group["lr"] = rate(number * STEPS + step, epochs * STEPS, PEAK, 100)
            x, weak, strong, strengths = _batch(lambda: triple(sources, rng, TRAIN_KINDS), BATCH)
            features = [y.chunk(3) for y in model.stack(torch.cat([x, weak, strong]))]
            near, far = (
                model.between([y[0] for y in features], [y[k] for y in features]) for k in (1, 2)
            )
            d = torch.cat([near, far])
            order = functional.softplus(
                -4 * (torch.log(far + 1e-5) - torch.log(near + 1e-5))
            ).mean()
            # So that the number itself reads as a strength: 1 is ruined.
            reads = ((d + 1e-6).sqrt() - strengths.T.reshape(-1) / 5).square().mean()
            loss = order + reads
            descend(optimizer, model, loss)
            total += float(loss.detach())
            right += int((far > near).sum())
        return {"loss": total / STEPS, "ordered": right / (STEPS * BATCH)}

    checkpoint = out / "perceptual-small.pt"
    Run(
        checkpoint, {"model": model, "optimizer": optimizer}, epochs, settings(globals(), "train")
    ).train(epoch)
    return checkpoint
