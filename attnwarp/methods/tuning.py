"""Tuning of the splats on edited views: lifted colours, L1, perceptual distance, normals, depth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import losses
from attnwarp.camera import Camera
from attnwarp.encoders import EncoderInfo, load_encoder
from attnwarp.fit import FitSettings, Views, extent_of
from attnwarp.fit.model import Model
from attnwarp.gaussians import SH_C0, Gaussians
from attnwarp.io import FileFormatError
from attnwarp.methods.settings import MethodSettings
from attnwarp.render import Render, render
from attnwarp.workdir import Workdir

Order = Callable[[int], int]
"""Order of a round's views: the view of an iteration, by the iteration's number in the
round.
"""


class PerceptualLoss(Protocol):
    """A perceptual distance with a gradient."""

    @property
    def about(self) -> EncoderInfo:
        """Identity of the weights."""
        ...

    @property
    def smallest(self) -> int:
        """Shortest accepted side of a picture, px."""
        ...

    def features(self, picture: Tensor) -> list[Tensor]:
        """Compute the compared features of a picture (H, W, 3) in [0, 1]."""
        ...

    def between(self, image: list[Tensor], target: list[Tensor]) -> Tensor:
        """Compute the distance () of two pictures from their features."""
        ...


def perceptual_net(
    settings: MethodSettings, device: str = "cpu", load: Callable[..., Any] = load_encoder
) -> PerceptualLoss | None:
    """Load the settings' perceptual distance on a device; None if no iteration uses it."""
    if not (settings.perceptual and settings.iterations):
        return None
    return cast(PerceptualLoss, load(settings.perceptual_encoder, "perceptual", device=device))


HELD_BYTES = 2**31
"""Bytes of views to tune on that are kept: 164 of 1297 x 840 px."""


FEATURE_BYTES = 2**30
"""Bytes of pictures' features that :class:`DistanceToViews` keeps: 80 views of 256 px."""


LIFT_SWEEPS = 3
"""Number of sweeps over the views in :meth:`Tuning.lift`; 10 gain nothing that shows."""

LIFT_ERROR = 0.03
"""Error of a pixel, of 1, up to which :meth:`Tuning.lift` counts it as right."""

LEAST_WEIGHT = 1e-3
"""Damping of splats that hardly show in any view, as a sum of their shares of pixels, which then
stay as they were. From 0 to 1 all do as well, in edited views and in others (four drawn scenes).
"""


class DistanceToViews:
    """Perceptual distance of renders to the pictures of views.

    The features of a view's picture are computed once while the view lives, and kept for the first
    views that fit. An iteration on a kept view needs a third less of the network.

    Args:
        kept_bytes: limit on the bytes of kept features.
        scaled: False feeds pictures in [0, 1] as if they were in [-1, 1].
    """

    def __init__(
        self, perceptual: PerceptualLoss, kept_bytes: int = FEATURE_BYTES, scaled: bool = True
    ) -> None:
        self._perceptual, self._bytes, self._scaled = perceptual, kept_bytes, scaled
        self._kept: WeakKeyDictionary[Views, dict[int, list[Tensor]]] = WeakKeyDictionary()

    def __call__(self, image: Tensor, views: Views, index: int) -> Tensor:
        """Compute the distance () of a render (H, W, 3), differentiable, to a view's picture."""
        target = self._of(views, index, image.device)
        return self._perceptual.between(self._features(image), target)

    def _features(self, image: Tensor) -> list[Tensor]:
        return self._perceptual.features(image if self._scaled else (image + 1) / 2)

    def _of(self, views: Views, index: int, device: torch.device) -> list[Tensor]:
        kept = self._kept.setdefault(views, {})
        if index in kept:
            return kept[index]
        with torch.no_grad():
            features = self._features(target_of(views, index, device))
        held = sum(x.nbytes for each in self._kept.values() for one in each.values() for x in one)
        if held + sum(x.nbytes for x in features) <= self._bytes:
            kept[index] = features
        return features


def target_of(views: Views, index: int, device: torch.device) -> Tensor:
    """Return the picture (H, W, 3) that a view is tuned on, black where its mask ignores it."""
    black = torch.zeros(3, dtype=torch.float32, device=device)
    return views.masked(index, views.target(index, black))


class Tuning:
    """Splats, their optimiser and its progress, shared by all rounds.

    Args:
        cameras: cameras of all views, which determine the scene's extent.
        iterations: total number of iterations, over which the centres' learning rate falls.
        membership: (N,) in [0, 1], factor of each splat's steps; None for 1. A splat with factor 0
            keeps its bytes.

    Attributes:
        visits: number of iterations on each view, by the view's number.
        weights: SHA-256 of each loss network's weights, by the loss.
    """

    def __init__(
        self,
        start: Gaussians,
        cameras: Sequence[Camera],
        settings: MethodSettings,
        iterations: int,
        backend: str = "auto",
        membership: npt.NDArray[np.floating[Any]] | None = None,
        load: Callable[..., Any] = load_encoder,
    ) -> None:
        self.settings, self.iterations, self.backend = settings, iterations, backend
        rates = FitSettings(kind=start.kind)
        rate = settings.color_rate
        self.fit = FitSettings(
            kind=start.kind,
            sh_degree=start.sh_degree,
            antialiased=start.antialiased,
            lr_dc=rate * rates.lr_dc,
            lr_rest=rate * rates.lr_rest,
        )
        self.model = Model(start, self.fit, extent_of(cameras, start.world_means()))
        self.membership = (
            None
            if membership is None
            else torch.from_numpy(membership).to(self.model.tensors["means"])
        )
        self.random = torch.Generator().manual_seed(settings.seed)
        self.queue: list[int] = []
        self.iteration = 0
        self.lifts = getattr(settings, "training", "") == "lifted"
        self.loss = math.nan
        self.visits: dict[int, int] = {}
        # Loaded here, not at its first use, which may follow hours of editing.
        net = perceptual_net(settings, str(self.model.device), load)
        self._smallest: list[tuple[str, int, str]] = []
        if net is not None:
            name = f"the perceptual distance {net.about.name}"
            self._smallest.append((name, net.smallest, "perceptual"))
        if settings.ssim and settings.iterations:
            self._smallest.append(("SSIM", losses.SSIM_WINDOW, "ssim"))
        scaled = getattr(settings, "perceptual_scaled", True)
        self.perceptual = None if net is None else DistanceToViews(net, scaled=scaled)
        self.weights = {} if net is None else {"perceptual": net.about.weights_sha256}

    def check_sizes(self, cameras: Sequence[Camera]) -> None:
        """Raise ValueError, naming the view, if a view to tune on is too small for a loss."""
        for loss, smallest, setting in self._smallest:
            losses.check_sizes(cameras, smallest, loss, setting)

    def gaussians(self) -> Gaussians:
        """Return the current splats, outside autograd."""
        return self.model.gaussians().detach()

    def advance(
        self,
        begin: int,
        end: int,
        views: Views,
        numbers: Sequence[int],
        order: Order | None = None,
        *,
        spent: Callable[[], bool] = lambda: False,
        step: Callable[[], None] = lambda: None,
    ) -> None:
        """Tune from the current iteration to the end of a round, or until the budget is spent.

        A round with iterations begins with :meth:`lift`, if the settings say so.

        Args:
            views: views to tune on.
            numbers: their numbers among all views, for :attr:`visits`.
            order: order of the views; None takes each once before any comes again, at random.
            spent: function that returns True once no further iteration may begin.
            step: function to call after each of the round's :meth:`steps`.
        """
        if self.iteration == begin:
            self.queue = []  # the previous round had different views
            if self.lifts and end > begin:
                self.lift(views, spent=spent, step=step)
        while self.iteration < end and not spent():
            index = self._next(len(views), self.iteration - begin, order)
            self._iterate(views, index)
            self.visits[numbers[index]] = self.visits.get(numbers[index], 0) + 1
            step()

    def steps(self, views: int, iterations: int) -> int:
        """Count the steps of a round's first iterations: those, and the views that lifting sweeps.

        A view of a sweep takes about as long as an iteration.
        """
        return iterations + (LIFT_SWEEPS * views if self.lifts and iterations else 0)

    def lift(
        self,
        views: Views,
        *,
        spent: Callable[[], bool] = lambda: False,
        step: Callable[[], None] = lambda: None,
    ) -> None:
        """Move each splat's colour by the mean change that its pixels in all views ask for.

        A pixel counts by the splat's share of it, and the less the farther it is from its picture,
        so a splat takes the colour on which most views agree. The renderer is linear in the
        colours, so these are steps of SIRT (Gilbert 1972) with weights for the least absolute
        error (Holland and Welsch 1977), where Adam takes hundreds. Geometry stays, and so does how
        colours depend on the direction.

        Args:
            spent: function that returns True once no further view may begin. A sweep that it ends
                changes nothing, as a part of the views would pull all splats their way.
            step: function to call after each view.
        """
        colors = self.model.tensors["dc"].detach()
        for _ in range(LIFT_SWEEPS):
            # Drawn as values of their own, since a colour below black has no slope.
            sums = torch.zeros_like(colors[:, 0].repeat(1, 2))
            for index in range(len(views)):
                if spent():
                    return
                with torch.no_grad():
                    color = self._render(views.cameras[index]).color.float()
                    image = views.masked(index, views.exposed(index, color))
                    missing = target_of(views, index, image.device) - image
                    trust = 1 / missing.abs().mean(-1, keepdim=True).clamp_min(LIFT_ERROR)
                    # A picture that is exposed asks by its gain, and knows as much.
                    gain = views.gain(index, missing)
                    known = (gain.abs().sum(1) @ gain.abs()).expand_as(missing)
                    asked = torch.cat([missing @ gain, known], dim=-1) * trust
                    asked = views.masked(index, asked)
                values = torch.zeros_like(sums).requires_grad_(True)
                drawn = self._render(views.cameras[index], features=values).color
                sums += torch.autograd.grad((drawn * asked).sum(), values)[0]
                step()
            change, weight = sums[:, None, :3], sums[:, None, 3:]
            moved = torch.where(weight > 0, change / weight.clamp_min(LEAST_WEIGHT), 0) / SH_C0
            colors += moved if self.membership is None else moved * self.membership[:, None, None]

    def _next(self, count: int, number: int, order: Order | None) -> int:
        if order is not None:
            return order(number)
        if not self.queue:
            self.queue = torch.randperm(count, generator=self.random).tolist()
        return self.queue.pop()

    def state(self) -> dict[str, Any]:
        """Collect the state that the next iteration depends on."""
        return {
            "model": self.model.state(),
            "random": self.random.get_state(),
            "queue": list(self.queue),
            "iteration": self.iteration,
            "loss": self.loss,
            "visits": dict(self.visits),
        }

    def restore(self, folder: Workdir, name: str) -> None:
        """Resume from a checkpoint of a folder."""
        state = folder.load(name)
        try:
            self.model.restore(state["model"])
            self.random.set_state(state["random"])
            self.queue = list(state["queue"])
            self.iteration, self.loss = int(state["iteration"]), float(state["loss"])
            self.visits = {int(view): int(n) for view, n in state["visits"].items()}
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            path = folder.path / name
            raise FileFormatError(path, f"lacks something ({error}); remove it") from error

    def _render(
        self, camera: Camera, background: Tensor | None = None, features: Tensor | None = None
    ) -> Render:
        try:
            gaussians = self.model.gaussians()
        except ValueError as error:
            raise RuntimeError(f"tuning, iteration {self.iteration}: {error}") from error
        return render(
            gaussians,
            camera,
            features=features,
            backend=self.backend,
            background=background,
            near=self.fit.near * self.model.extent,
        )

    def _iterate(self, views: Views, index: int) -> None:
        camera = views.cameras[index]
        background = self.model.background(self.settings.background, self.random)
        picture = self._render(camera, background)
        loss = self.loss_of(picture, views, index)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise RuntimeError(
                f"tuning, iteration {self.iteration}: the loss is {value} on view"
                f" {camera.name!r}; lower color_rate"
            )
        loss.backward()
        self.iteration += 1
        self._step(self.iteration / max(1, self.iterations))
        self.loss = value

    def _step(self, progress: float) -> None:
        """Take one step of the model, scaled for each splat by its membership."""
        if self.membership is None:
            self.model.step(progress)
            return
        tensors = self.model.tensors
        before = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        self.model.step(progress)
        with torch.no_grad():
            for name, tensor in tensors.items():
                share = self.membership.reshape(-1, *[1] * (tensor.dim() - 1))
                tensor.copy_(torch.lerp(before[name], tensor, share))

    def loss_of(self, picture: Render, views: Views, index: int) -> Tensor:
        """Compute the weighted sum of the losses."""
        s = self.settings
        image = views.masked(index, views.exposed(index, picture.color.float()))
        target = target_of(views, index, image.device)
        loss = s.l1 * losses.l1(image, target)
        if self.perceptual is not None:
            loss = loss + s.perceptual * self.perceptual(image.clamp(0, 1), views, index).to(loss)
        if s.ssim:
            loss = loss + s.ssim * (1 - losses.ssim(image, target))
        if s.normal:
            loss = loss + s.normal * losses.normal_consistency(picture)
        if s.distortion:
            distortion = losses.depth_distortion(picture, scale=self.model.extent)
            loss = loss + s.distortion * distortion
        return loss
