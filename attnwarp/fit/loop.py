"""Optimisation loop: one view per iteration, until iterations, time or patience end."""

from __future__ import annotations

import math
import os
import statistics
import time
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check, losses
from attnwarp.devices import on_cpu_unless_named, with_gradients
from attnwarp.errors import InputWarning
from attnwarp.fit.densify import Density
from attnwarp.fit.exposure import Exposure
from attnwarp.fit.model import Model
from attnwarp.fit.settings import FitSettings
from attnwarp.fit.start import extent_of, upward
from attnwarp.fit.views import Views
from attnwarp.fit.warm import compile_kernels
from attnwarp.gaussians import Gaussians
from attnwarp.io import FileFormatError, write_ply
from attnwarp.render import Render, render
from attnwarp.render.api import WORK
from attnwarp.reporting import SILENT, Pace, Reporter
from attnwarp.workdir import CheckpointClock, Workdir, results_in

Tensor = torch.Tensor
Measure = Callable[[Gaussians], dict[str, float]]

CHECKPOINT = "checkpoint.pt"
SPLATS = "splats.ply"

NAMED = {"start": "first splats", "held_out": "held-out views"}
"""Names of the parts of a fit's identity in messages."""

LEAST_SEEN = 1 / 255
"""Least contribution of a splat to all pictures together: one grey level of one pixel."""

LEAST_CHOOSING = 3
"""Least number of views that choose, so that the median of their PSNR outvotes one outlier."""

SMOOTHING = 0.98
"""Weight of past values in the smoothed loss and PSNR shown during a fit."""


@dataclass(frozen=True)
class Record:
    """Point on the curve of accuracy against time.

    Attributes:
        iteration: iterations done.
        seconds, cpu_seconds: time of iterations alone, without evaluation and writing, over all
            processes of the fit.
        splats: number of splats.
        loss: smoothed loss of the last iterations; None before the first.
        psnr: mean over the held-out views that choose nothing, dB; None without such views.
            Infinite if all equal their pictures.
        psnr_pooled: PSNR of those views' mean squared error.
        choosing: median PSNR of the held-out views that choose the splats, dB; None without them.
        measures: figures of the caller's measure.

    Example:
        >>> from attnwarp.fit import Record
        >>> record = Record(100, 2.0, 3.5, 60, loss=0.02, psnr=28.0, psnr_pooled=27.5)
        >>> record.iteration / record.seconds  # iterations a second
        50.0
    """

    iteration: int
    seconds: float
    cpu_seconds: float
    splats: int
    loss: float | None
    psnr: float | None
    psnr_pooled: float | None
    choosing: float | None = None
    measures: dict[str, float] = field(default_factory=dict)


@dataclass(eq=False)
class Fit:
    """Result of a fit.

    Attributes:
        gaussians: the splats, float32, outside autograd; with views that choose, those of
            ``kept``.
        settings: settings used.
        history: evaluations, the first before the first iteration, the last at the end.
        iteration: iterations done.
        seconds, cpu_seconds: time of the iterations.
        stopped: reason of the end: "iterations" (all done), "time", "patience", or "asked".
        extent: extent of the scene, the unit of the settings' shares.
        kept: evaluation of the returned splats.
        exposures: (3, 4) change of colour of each fitted view, for
            :class:`attnwarp.fit.Views`; empty unless the settings estimate exposure.
        pairs: splat-pixel pairs that the iterations rendered, in all processes.

    Example:
        >>> import numpy as np
        >>> from attnwarp.fit import FitSettings, Views, fit, from_points
        >>> from attnwarp.trial import view
        >>> start = from_points(np.eye(3), kind="3d", sh_degree=0)
        >>> grey = Views([view(side=16)], [np.full((16, 16, 3), 0.5)])
        >>> result = fit(start, grey, FitSettings(kind="3d", iterations=2, sh_degree=0))
        >>> result.stopped, [record.iteration for record in result.history]
        ('iterations', [0, 2])
    """

    gaussians: Gaussians
    settings: FitSettings
    history: list[Record]
    iteration: int
    seconds: float
    cpu_seconds: float
    stopped: str
    extent: float
    kept: Record
    exposures: list[npt.NDArray[np.float32]] = field(default_factory=list)
    pairs: int = 0


@on_cpu_unless_named
@with_gradients
def fit(
    start: Gaussians,
    views: Views,
    settings: FitSettings | None = None,
    *,
    held_out: Views | None = None,
    folder: str | os.PathLike[str] | None = None,
    restart: bool = False,
    max_seconds: float | None = None,
    checkpoint_seconds: float = 30.0,
    backend: str = "auto",
    measure: Measure | None = None,
    report: Reporter = SILENT,
    stop: Callable[[], bool] | None = None,
) -> Fit:
    """Fit splats to posed pictures.

    With ``folder``, a checkpoint and the splats so far (``splats.ply``) are written there every
    ``checkpoint_seconds`` and at the end, each atomically. A fit with a checkpoint is resumed. On
    the same machine, with the same number of torch threads, it gives the bits of an uninterrupted
    fit. A fit planned with another number of iterations continues to the new end, and the report
    says that its past iterations followed another schedule.

    With ``settings.patience`` and at least four held-out views, some of them choose
    (:func:`choosing`): of the evaluations after the last refinement, the splats of the one that
    shows these best are returned. The reported PSNR is that of the others.

    Args:
        start: first splats, of the settings' kind: from :func:`attnwarp.fit.from_points`, or from
            an earlier fit. Their harmonics are used from the first iteration. The fit runs on
            their device: ``start.to(device="cuda")`` selects a GPU.
        views: pictures to fit on.
        settings: settings of the fit; the defaults for ``start.kind`` if omitted.
        held_out: pictures to evaluate on, never fitted on.
        folder: folder of the checkpoint, created if missing.
        restart: True ignores the folder's checkpoint and overwrites its splats.
        max_seconds: limit on the seconds of iterations over all processes; compiling kernels is
            excluded. The learning rates still follow ``settings.iterations``.
        checkpoint_seconds: time between checkpoints; extended for a slow checkpoint, so that
            writing takes 5 % of the time.
        backend: renderer name, as for :func:`attnwarp.render.render`.
        measure: function of the splats, called at every evaluation; its figures enter the history.
            It can compare with ground truth, such as the error of depth.
        report: receiver of progress after every iteration.
        stop: function called before every iteration; True ends the fit regularly.

    Raises:
        ValueError: ``start`` differs in kind or degree from the settings; the folder holds a fit of
            other views, settings or first splats, a fit beyond ``settings.iterations``, or
            ``splats.ply`` without a checkpoint; or a number is out of range.
        FileFormatError: the folder's checkpoint is damaged.
        InputError: another run writes to the folder.
        RuntimeError: the loss or a held-out view is not finite, or no splat is left; the message
            suggests a remedy. The last checkpoint is kept.

    Warns:
        InputWarning: world coordinates in ``splats.ply`` exceed float32's precision.

    Example:
        >>> import numpy as np
        >>> from attnwarp.fit import FitSettings, Views, fit, from_points
        >>> from attnwarp.trial import view
        >>> start = from_points(np.eye(3), kind="3d", sh_degree=0)
        >>> grey = Views([view(side=16)], [np.full((16, 16, 3), 0.5)])
        >>> fit(start, grey, FitSettings(kind="3d", iterations=2, sh_degree=0)).iteration
        2
    """
    check.instance(start, Gaussians, "start", "attnwarp.Gaussians")
    check.instance(views, Views, "views", "attnwarp.fit.Views")
    if held_out is not None:
        check.instance(held_out, Views, "held_out", "attnwarp.fit.Views")
    if settings is not None:
        check.instance(settings, FitSettings, "settings", "attnwarp.fit.FitSettings")
    settings = (
        FitSettings(kind=start.kind, sh_degree=start.sh_degree) if settings is None else settings
    )
    if start.kind != settings.kind:
        raise ValueError(
            f"start: is of kind {start.kind!r}, but settings.kind is {settings.kind!r}"
        )
    if start.sh_degree != settings.sh_degree:
        raise ValueError(
            f"start: has harmonics of degree {start.sh_degree}, but settings.sh_degree is "
            f"{settings.sh_degree}"
        )
    if len(start) == 0:
        raise ValueError("start: holds no splats")
    if settings.ssim:
        losses.check_sizes(views.cameras, losses.SSIM_WINDOW, "SSIM", "ssim")
    if max_seconds is not None:
        check.seconds(max_seconds, "max_seconds")
    check.seconds(checkpoint_seconds, "checkpoint_seconds")
    if settings.max_splats is not None and len(start) > settings.max_splats:
        report.log(
            f"{len(start)} first splats, more than max_splats {settings.max_splats}: the fit keeps"
            " them all and adds none"
        )
    run = _Run(start, views, settings, held_out, backend, measure)
    with nullcontext() if folder is None else results_in(Path(folder)) as place:
        if place is not None:
            run.resume(Workdir(place, "a fit"), report, restart=restart)
        return run.go(max_seconds, CheckpointClock(checkpoint_seconds), report, stop)


class _Run:
    """Fit in progress: the state that the next iteration depends on."""

    def __init__(
        self,
        start: Gaussians,
        views: Views,
        settings: FitSettings,
        held_out: Views | None,
        backend: str,
        measure: Measure | None,
    ) -> None:
        self.settings, self.views, self.held_out = settings, views, held_out
        self.chooses = choosing(len(held_out or ()), settings)
        self.backend, self.measure = backend, measure
        self.extent = extent_of(views.cameras, start.world_means())
        centers = np.stack([camera.position for camera in views.cameras])
        self.start, self.first_degree = start.digest(), start.used_sh_degree()
        self.model = Model(start, settings, self.extent)
        up = upward(settings, views.cameras)
        if up is not None:
            self.model.keep_above(up, float((centers @ up).max()))
        middle = centers.mean(0) - self.model.origin
        self.density = Density(settings, self.extent, middle, len(start), self.model.device)
        self.exposure = Exposure(len(views), self.model.device) if settings.exposure else None
        self.best: dict[str, Tensor] = {}
        self.random = torch.Generator().manual_seed(settings.seed)
        self.queue: list[int] = []
        self.iteration = self.pairs = 0
        self.seconds = self.cpu_seconds = 0.0
        self.loss = self.error = math.nan
        self.history: list[Record] = []
        self.folder: Workdir | None = None

    def identity(self) -> dict[str, Any]:
        """Settings and data that a checkpoint must match to be resumed."""
        return {
            "settings": self.settings.to_dict(),
            "views": self.views.digest,
            "held_out": self.held_out.digest if self.held_out else None,
            "start": self.start,  # after the views, which give a sky its colours
            "origin": [float(v) for v in self.model.origin],
        }

    def resume(self, folder: Workdir, report: Reporter, *, restart: bool) -> None:
        self.folder = folder
        path = folder.path / CHECKPOINT
        if restart:
            return  # The old files stay until the first save replaces them.
        if not path.exists():
            splats = folder.path / SPLATS
            if splats.exists():
                raise ValueError(
                    f"folder: {splats} is there without {CHECKPOINT}, and a fit would write over"
                    " it; name another folder, or remove it to begin again"
                )
            return
        remedy = f"remove it and {SPLATS} to begin again"
        state = folder.load(CHECKPOINT, remedy)
        self._lengthen(state, report)
        for name, expected in self.identity().items():
            stored = state.get(name)
            if stored == expected:
                continue
            if isinstance(expected, dict) and isinstance(stored, dict):
                differ = [
                    f"{k}: {stored.get(k)!r}, now {expected.get(k, 'no setting')!r}"
                    for k in {**stored, **expected}
                    if k not in expected or stored.get(k) != expected[k]
                ]
                name = f"settings ({'; '.join(differ)})"
            raise ValueError(
                f"folder: {folder.path} holds a fit of other {NAMED.get(name, name)}; go on with"
                f" the same ones, or name another folder, or remove {path} and {SPLATS} to begin"
                " again"
            )
        try:
            self.model.restore(state["model"])
            self.density.restore(state["density"])
            if self.exposure is not None:
                self.exposure.restore(state["exposure"])
            self.best = dict(state["best"])
            self.random.set_state(state["random"])
            self.queue = list(state["queue"])
            self.iteration = int(state["iteration"])
            self.pairs = int(state.get("pairs", 0))  # earlier checkpoints have none
            self.seconds, self.cpu_seconds = float(state["seconds"]), float(state["cpu_seconds"])
            self.loss, self.error = float(state["loss"]), float(state["error"])
            self.history = [Record(**record) for record in state["history"]]
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise FileFormatError(
                path, f"lacks something or is damaged: {error}; {remedy}"
            ) from error

    def _lengthen(self, state: dict[str, Any], report: Reporter) -> None:
        """Resume a fit planned with another number of iterations, unless it is beyond this one."""
        settings, now = state.get("settings"), self.settings.iterations
        if not isinstance(settings, dict) or state.get("iteration", now) > now:
            return
        planned = settings.get("iterations", now)
        if planned != now:
            settings["iterations"] = now
            # By the new plan splats may be added again, and what is kept comes after them.
            state["best"] = {}
            for record in state.get("history", []):
                record["choosing"] = None
            report.log(
                f"a fit planned with {planned} iterations goes on to {now}; learning rates,"
                " densification and losses were those of the former plan so far, so a fit of"
                f" {now} in one go has other splats"
            )

    def save(self, gaussians: Gaussians) -> None:
        """Write the checkpoint, then the splats: splats without a checkpoint count as foreign."""
        if self.folder is None:
            return
        self.folder.save(
            CHECKPOINT,
            {
                **self.identity(),
                "model": self.model.state(),
                "density": self.density.state(),
                "exposure": None if self.exposure is None else self.exposure.state(),
                "best": self.best,
                "random": self.random.get_state(),
                "queue": list(self.queue),
                "iteration": self.iteration,
                "pairs": self.pairs,
                "seconds": self.seconds,
                "cpu_seconds": self.cpu_seconds,
                "loss": self.loss,
                "error": self.error,
                "history": [asdict(record) for record in self.history],
            },
        )
        write_ply(self.folder.path / SPLATS, gaussians)

    def go(
        self,
        max_seconds: float | None,
        clock: CheckpointClock,
        report: Reporter,
        stop: Callable[[], bool] | None,
    ) -> Fit:
        s = self.settings
        if self.backend in ("auto", "cpu") and self.iteration < s.iterations:
            compile_kernels(s.kind, report, self.model.device)
        if not self.history:
            self.evaluate()
        pace = Pace()
        while True:
            stopped = self._reason_to_stop(max_seconds, stop)
            if stopped:
                break
            wall, cpu, pairs = time.perf_counter(), time.process_time(), WORK["pairs"]
            self.iterate()
            self.pairs += WORK["pairs"] - pairs
            self.seconds += time.perf_counter() - wall
            self.cpu_seconds += time.process_time() - cpu
            # Evaluate before the final report, so that the last displayed figures are the result's.
            if self.iteration % s.evaluate_every == 0 or self.iteration == s.iterations:
                self.evaluate()
            left = pace.left(self.iteration, s.iterations)
            if max_seconds is not None:
                left = min(max_seconds - self.seconds, math.inf if left is None else left)
            report.step(self.iteration, s.iterations, self.figures(), left)
            if self.folder is not None and clock.due:
                with clock.saving(), warnings.catch_warnings():
                    warnings.simplefilter("ignore", InputWarning)  # said at the end
                    self.save(self.model.gaussians().detach())
        if self.history[-1].iteration != self.iteration:
            self.evaluate()
        gaussians = self.model.gaussians(self.best or None).detach()
        self.save(gaussians)
        changes = (self.best or self._snapshot()).get("exposures")
        return Fit(
            gaussians,
            s,
            list(self.history),
            self.iteration,
            self.seconds,
            self.cpu_seconds,
            stopped,
            self.extent,
            max(self.history, key=self.chosen) if self.best else self.history[-1],
            [] if changes is None else list(changes.cpu().numpy()),
            self.pairs,
        )

    def _snapshot(self) -> dict[str, Tensor]:
        """Copy the splats' leaves, and the exposures."""
        if self.exposure is None:
            return self.model.snapshot()
        return {**self.model.snapshot(), "exposures": self.exposure.changes().detach()}

    def drop_unseen(self) -> None:
        """Remove the splats that no fitted view shows."""
        # The gradient of a picture's sum in a splat's value is the splat's weight, behind all
        # that lies before it.
        gaussians = replace(self.model.gaussians().detach(), far=math.inf)
        values = torch.ones_like(gaussians.means[:, :1]).requires_grad_(True)
        near = self.settings.near * self.extent
        for camera in self.views.cameras:
            view = render(gaussians, camera, backend=self.backend, features=values, near=near)
            view.color.sum().backward()
        assert values.grad is not None
        seen = torch.nonzero(values.grad[:, 0] >= LEAST_SEEN)[:, 0]
        if len(seen):
            self.model.replace(
                seen, {name: t.detach()[:0] for name, t in self.model.tensors.items()}
            )
            self.density.clear(len(seen))

    def _reason_to_stop(self, max_seconds: float | None, stop: Callable[[], bool] | None) -> str:
        if self.iteration >= self.settings.iterations:
            return "iterations"
        if self._out_of_patience():
            return "patience"
        if max_seconds is not None and self.seconds >= max_seconds:
            return "time"
        return "asked" if stop is not None and stop() else ""

    def _out_of_patience(self) -> bool:
        patience, every = self.settings.patience, self.settings.evaluate_every
        # A stopped process evaluated once more, which must not shorten the patience.
        values = [
            self.chosen(record)
            for record in self.history
            if record.iteration % every == 0 and self.chosen(record) > -math.inf
        ]
        if patience is None or len(values) <= patience:
            return False
        return max(values[-patience:]) < max(values[:-patience]) + self.settings.min_gain

    def chosen(self, record: Record) -> float:
        """Likeness to the views that choose; none before the last refinement, since splats that
        nothing was added to can be nearer to a wrong picture than the finished ones.
        """
        early = self.settings.densify and record.iteration < self.density.last
        return -math.inf if early or record.choosing is None else record.choosing

    def figures(self) -> str:
        """Format a line with the smoothed loss and PSNR of the fitted pictures."""
        last = self.history[-1]
        held = "" if last.psnr is None else f", held out {_decibels(last.psnr)}"
        if held and last.iteration != self.iteration:
            held += f" at {last.iteration}"
        psnr = _decibels(losses.psnr_of_mse(self.error))
        return f"loss {self.loss:.4f}, PSNR {psnr}{held}, {len(self.model)} splats"

    def background(self, *, fitting: bool) -> Tensor:
        """Choose the background colour; never random for displayed or measured pictures."""
        choice = self.settings.background
        if choice == "auto":
            choice = "random" if self.views.transparent else "black"
        return self.model.background(choice, self.random if fitting else None)

    def iterate(self) -> None:
        s = self.settings
        # Refined at the beginning of an iteration, so that evaluated or written splats are never
        # fresh from a refinement, which costs some dB at first.
        self.density.refine(self.model, self.iteration, self.random)
        if s.densify and self.iteration == self.density.last:
            self.drop_unseen()
        if not self.queue:
            self.queue = torch.randperm(len(self.views), generator=self.random).tolist()
        index = self.queue.pop()
        camera = self.views.cameras[index]
        background = self.background(fitting=True)
        target = self.views.target(index, background)
        try:
            gaussians = self.model.gaussians(sh_degree=self.sh_degree)
        except ValueError as error:
            raise RuntimeError(
                f"after {self.iteration} iterations: {error}; lower the learning rates"
            ) from error
        view = self.render(gaussians, camera, background)
        expose = self.views.exposed if self.exposure is None else self.exposure
        image = self.views.masked(index, expose(index, view.color.float()))
        target = self.views.masked(index, target)
        loss = self.loss_of(image, view, target)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise RuntimeError(
                f"after {self.iteration} iterations: the loss is {value} on view {camera.name!r};"
                " lower the learning rates"
            )
        loss.backward()
        self.iteration += 1
        if self.density.active(self.iteration):
            self.density.watch(self.model, gaussians, camera, view.weight.detach())
        self.model.step(self.iteration / s.iterations)
        if self.exposure is not None:
            self.exposure.step(self.iteration / s.iterations)
        squared = float((image.detach() - target).square().mean())
        self.loss, self.error = _smoothed(self.loss, value), _smoothed(self.error, squared)

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics in use, which grows during the fit."""
        s = self.settings
        more = self.iteration // max(1, round(s.sh_every * s.iterations))
        return min(s.sh_degree, self.first_degree + more)

    def render(self, gaussians: Gaussians, camera: Any, background: Tensor) -> Render:
        return render(
            gaussians,
            camera,
            backend=self.backend,
            background=background,
            sh_degree=self.sh_degree,
            near=self.settings.near * self.extent,
        )

    def loss_of(self, image: Tensor, view: Render, target: Tensor) -> Tensor:
        s = self.settings
        loss = (1 - s.ssim) * losses.l1(image, target)
        if s.ssim:
            loss = loss + s.ssim * (1 - losses.ssim(image, target))
        done = self.iteration / s.iterations
        if s.normal_weight and done >= s.normal_from:
            loss = loss + s.normal_weight * losses.normal_consistency(view)
        if s.distortion_weight and done >= s.distortion_from:
            distortion = losses.depth_distortion(view, scale=self.extent)
            loss = loss + s.distortion_weight * distortion
        return loss

    def evaluate(self) -> None:
        gaussians = self.model.gaussians().detach()
        both: list[list[float]] = [[], []]
        if self.held_out is not None:
            background = self.background(fitting=False)
            for index, camera in enumerate(self.held_out.cameras):
                image = self.render(gaussians, camera, background).color.clamp(0, 1)
                error = self.held_out.error(index, image, background)
                both[index in self.chooses].append(error)
                if math.isnan(error):
                    raise RuntimeError(
                        f"after {self.iteration} iterations: the held-out view {camera.name!r}"
                        " renders as NaN; lower the learning rates"
                    )
        errors, choosing = both
        record = Record(
            iteration=self.iteration,
            seconds=self.seconds,
            cpu_seconds=self.cpu_seconds,
            splats=len(self.model),
            loss=None if math.isnan(self.loss) else self.loss,
            psnr=_mean_psnr(errors),
            psnr_pooled=losses.psnr_of_mse(sum(errors) / len(errors)) if errors else None,
            choosing=_median_psnr(choosing),
            measures=dict(self.measure(gaussians)) if self.measure else {},
        )
        if self.chosen(record) > max(map(self.chosen, self.history), default=-math.inf):
            self.best = self._snapshot()
        self.history.append(record)


def choosing(held_out: int, settings: FitSettings) -> list[int]:
    """Choose the held-out views that decide which splats are kept, by their numbers: every second
    one, but at least three. What is chosen on is never what is reported on, so none of three views.

    Example:
        >>> from attnwarp.fit import FitSettings
        >>> from attnwarp.fit.loop import choosing
        >>> [choosing(count, FitSettings(patience=4)) for count in (3, 4, 7)]
        [[], [1, 2, 3], [1, 3, 5]]
        >>> choosing(7, FitSettings())
        []
    """
    if not settings.patience or held_out <= LEAST_CHOOSING:
        return []
    reported = range(0, held_out, 2)[: held_out - LEAST_CHOOSING]
    return [view for view in range(held_out) if view not in reported]


def _smoothed(before: float, value: float) -> float:
    return value if math.isnan(before) else SMOOTHING * before + (1 - SMOOTHING) * value


def _mean_psnr(errors: list[float]) -> float | None:
    return sum(map(losses.psnr_of_mse, errors)) / len(errors) if errors else None


def _median_psnr(errors: list[float]) -> float | None:
    return statistics.median(map(losses.psnr_of_mse, errors)) if errors else None


def _decibels(value: float) -> str:
    return f"{value:.2f} dB" if math.isfinite(value) else "inf dB"
