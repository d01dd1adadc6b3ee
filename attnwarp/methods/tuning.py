"""Tuning of the splats on edited views: L1, perceptual distance, normals, depth distortion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, cast
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from attnwarp import losses
from attnwarp.camera import Camera
from attnwarp.encoders import EncoderInfo, load_encoder
from attnwarp.fit import FitSettings, extent_of
from attnwarp.fit.model import Model
from attnwarp.gaussians import Gaussians
from attnwarp.io import FileFormatError
from attnwarp.methods.pictures import Image
from attnwarp.methods.settings import MethodSettings
from attnwarp.render import Render, render
from attnwarp.workdir import Workdir

Order = Callable[[int], int]
"""Order of a round's views: the view that an iteration takes, by the iteration's number in the
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
        """Shortest side of a picture that it takes, px."""
        ...

    def features(self, picture: Tensor) -> list[Tensor]:
        """Features that are compared, of a picture (H, W, 3) in [0, 1]."""
        ...

    def between(self, image: list[Tensor], target: list[Tensor]) -> Tensor:
        """() the distance of two pictures by their features."""
        ...


def perceptual_net(
    settings: MethodSettings, device: str = "cpu", load: Callable[..., Any] = load_encoder
) -> PerceptualLoss | None:
    """The perceptual distance of the settings on a device; None where no iteration takes it.

    Args:
        settings: name it.
        device: device of its network.
        load: called as :func:`attnwarp.encoders.load_encoder` is.

    Raises:
        InputError: no such encoder, or one of another kind.
    """
    if not (settings.perceptual and settings.iterations):
        return None
    return cast(PerceptualLoss, load(settings.perceptual_encoder, "perceptual", device=device))


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A view to tune on.

    Attributes:
        number: number of the view.
        camera: camera of the size of the picture.
        picture: (H, W, 3) in [0, 1].
    """

    number: int
    camera: Camera
    picture: Image

    def on(self, device: torch.device) -> Tensor:
        """(H, W, 3) the picture on a device, where it stays as long as the view."""
        return self._tensors.setdefault(device, torch.from_numpy(self.picture).to(device))

    @cached_property
    def _tensors(self) -> dict[torch.device, Tensor]:
        return {}


HELD_BYTES = 2**31
"""Bytes of pictures that :class:`DrawnViews` keeps: 164 of 1297 x 840 px."""


class DrawnViews(Sequence[TrainingView]):
    """Views to tune on that are made when they are drawn. The first whose pictures fit are kept;
    floating pictures of all views at once may fill the memory.

    Args:
        makers: one a view.
        held_bytes: bytes of pictures that are kept.
    """

    def __init__(
        self, makers: Sequence[Callable[[], TrainingView]], held_bytes: int = HELD_BYTES
    ) -> None:
        self._makers = makers
        self._held: dict[int, TrainingView] = {}
        self._left = held_bytes

    def __len__(self) -> int:
        return len(self._makers)

    def __getitem__(self, index: Any) -> Any:
        """The view of a number, made anew where it is not kept."""
        if index in self._held:
            return self._held[index]
        view = self._makers[index]()
        if view.picture.nbytes <= self._left:
            self._left -= view.picture.nbytes
            self._held[index] = view
        return view


FEATURE_BYTES = 2**30
"""Bytes of pictures' features that :class:`DistanceToViews` keeps: 80 views of 256 px."""


class DistanceToViews:
    """The perceptual distance of renders to the pictures of views.

    What it compares of a view's picture is worked out once while the view lives, and kept for the
    first views that fit. An iteration on a kept view takes a third less of the network.

    Args:
        perceptual: the distance.
        kept_bytes: bytes of the pictures' features.
    """

    def __init__(self, perceptual: PerceptualLoss, kept_bytes: int = FEATURE_BYTES) -> None:
        self._perceptual, self._bytes = perceptual, kept_bytes
        self._kept: WeakKeyDictionary[TrainingView, list[Tensor]] = WeakKeyDictionary()

    def __call__(self, image: Tensor, view: TrainingView) -> Tensor:
        """() of a render (H, W, 3) in [0, 1], which may need a gradient, to a view's picture."""
        target = self._of(view, image.device)
        return self._perceptual.between(self._perceptual.features(image), target)

    def _of(self, view: TrainingView, device: torch.device) -> list[Tensor]:
        if view in self._kept:
            return self._kept[view]
        with torch.no_grad():
            features = self._perceptual.features(view.on(device))
        held = sum(x.nbytes for kept in self._kept.values() for x in kept)
        if held + sum(x.nbytes for x in features) <= self._bytes:
            self._kept[view] = features
        return features


class Tuning:
    """Splats, their optimiser and its place in the work; goes on through all rounds.

    Args:
        start: the splats before the edit.
        cameras: cameras of all views; they decide the extent.
        settings: losses, rates, background, seed.
        iterations: in all, over which the centres' learning rate falls.
        backend: name of the renderer.
        membership: (N,) in [0, 1], factor of each splat's steps; None for 1. A splat of 0 keeps its
            bytes.
        load: load of the perceptual distance, see :func:`perceptual_net`.

    Attributes:
        iteration: iterations done, over all rounds.
        loss: loss of the last iteration.
        visits: how often each view was tuned on, by its number.
        weights: by the loss that has them, the SHA-256 of its network's.

    Raises:
        InputError: no such perceptual distance.
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
        self.loss = math.nan
        self.visits: dict[int, int] = {}
        # Here and not at its first use: before it, views are edited for hours.
        net = perceptual_net(settings, str(self.model.device), load)
        self._smallest: list[tuple[str, int, str]] = []
        if net is not None:
            name = f"the perceptual distance {net.about.name}"
            self._smallest.append((name, net.smallest, "perceptual"))
        if settings.ssim and settings.iterations:
            self._smallest.append(("SSIM", losses.SSIM_WINDOW, "ssim"))
        self.perceptual = None if net is None else DistanceToViews(net)
        self.weights = {} if net is None else {"perceptual": net.about.weights_sha256}

    def check_sizes(self, cameras: Sequence[Camera]) -> None:
        """Raise ValueError that names a view to tune on that is too small for a loss."""
        for loss, smallest, setting in self._smallest:
            losses.check_sizes(cameras, smallest, loss, setting)

    def gaussians(self) -> Gaussians:
        """The splats as they stand, outside autograd."""
        return self.model.gaussians().detach()

    def advance(
        self,
        begin: int,
        end: int,
        views: Sequence[TrainingView],
        order: Order | None = None,
        *,
        spent: Callable[[], bool] = lambda: False,
        step: Callable[[], None] = lambda: None,
    ) -> None:
        """Tune through a round, from wherever it stands to its end, or until the budget is spent.

        Args:
            begin, end: iterations of the round.
            views: to tune on.
            order: order of the views; None takes each once before any comes again, at random.
            spent: true once no further iteration may begin.
            step: called after each iteration.
        """
        if self.iteration == begin:
            self.queue = []  # of the round before, whose views were others
        while self.iteration < end and not spent():
            self._iterate(self._next(views, self.iteration - begin, order))
            step()

    def _next(
        self, views: Sequence[TrainingView], number: int, order: Order | None
    ) -> TrainingView:
        if order is not None:
            return views[order(number)]
        if not self.queue:
            self.queue = torch.randperm(len(views), generator=self.random).tolist()
        return views[self.queue.pop()]

    def state(self) -> dict[str, Any]:
        """Everything that the next iteration depends on."""
        return {
            "model": self.model.state(),
            "random": self.random.get_state(),
            "queue": list(self.queue),
            "iteration": self.iteration,
            "loss": self.loss,
            "visits": dict(self.visits),
        }

    def restore(self, folder: Workdir, name: str) -> None:
        """Go on from a checkpoint of a folder.

        Raises:
            FileFormatError: it is damaged.
        """
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

    def _iterate(self, view: TrainingView) -> None:
        background = self._background()
        try:
            gaussians = self.model.gaussians()
        except ValueError as error:
            raise RuntimeError(f"tuning, iteration {self.iteration}: {error}") from error
        picture = render(
            gaussians,
            view.camera,
            backend=self.backend,
            background=background,
            near=self.fit.near * self.model.extent,
        )
        loss = self.loss_of(picture, view)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise RuntimeError(
                f"tuning, iteration {self.iteration}: the loss is {value} on view"
                f" {view.camera.name!r}; lower color_rate"
            )
        loss.backward()
        self.iteration += 1
        self._step(self.iteration / max(1, self.iterations))
        self.loss = value
        self.visits[view.number] = self.visits.get(view.number, 0) + 1

    def _step(self, progress: float) -> None:
        """One step of the model, of which each splat takes its membership's share."""
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

    def loss_of(self, picture: Render, view: TrainingView) -> Tensor:
        """The weighted sum of the losses.

        Args:
            picture: the render.
            view: picture that it shall become.
        """
        s = self.settings
        image = picture.color.float()
        target = view.on(image.device)
        loss = s.l1 * losses.l1(image, target)
        if self.perceptual is not None:
            loss = loss + s.perceptual * self.perceptual(image.clamp(0, 1), view).to(loss)
        if s.ssim:
            loss = loss + s.ssim * (1 - losses.ssim(image, target))
        if s.normal:
            loss = loss + s.normal * losses.normal_consistency(picture)
        if s.distortion:
            distortion = losses.depth_distortion(picture, "ordered", scale=self.model.extent)
            loss = loss + s.distortion * distortion
        return loss

    def _background(self) -> Tensor:
        choice = self.settings.background
        if choice == "random":
            drawn = torch.rand(3, generator=self.random, dtype=torch.float32)
            return drawn.to(self.model.device)
        value = 1.0 if choice == "white" else 0.0
        return torch.full((3,), value, dtype=torch.float32, device=self.model.device)
