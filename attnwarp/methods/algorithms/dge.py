"""Direct Gaussian Editor (Chen et al. 2024): edit views together, as frames of a film whose
tokens are matched along epipolar lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch

from attnwarp import check
from attnwarp.camera import Camera
from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from attnwarp.editing.schedule import Grid, following, published_steps
from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Loop, Method, ViewEdit
from attnwarp.methods.doors import door
from attnwarp.methods.matching import key_views
from attnwarp.methods.settings import LAST_STEP, MethodSettings
from attnwarp.methods.work import KEYS, VIEWS, Work, chunks, parts_of
from attnwarp.settings import Count, Number, Range, Weight


@dataclass(frozen=True)
class DGESettings(MethodSettings):
    """Settings of :func:`attnwarp.methods.dge`.

    Args:
        every: number of tuning iterations between two draws and edits of views.
        views: number of views per round; all views if there are fewer.
        batch: number of neighbouring views that share a key view.
        starts: starting timestep of each round; the last also serves all further rounds.
        grid: grid of the steps below the start, :data:`attnwarp.editing.schedule.Grid`.
        plain_below: timestep below which every view uses plain self-attention.
        epipolar: distance from the epipolar line, in px of the layer, beyond which matches are
            excluded; None excludes none.

    Example:
        >>> from attnwarp.methods import DGESettings
        >>> DGESettings().starts  # nearly pure noise first, small changes after
        (998, 299)
    """

    iterations: Number = 1500
    l1: Weight = 10.0
    ssim: Weight = 0.0
    perceptual: Weight = 10.0
    every: Count = 500
    views: Count = 20
    batch: Count = 5
    starts: tuple[int, ...] = (998, 299)
    grid: Grid = "even"
    plain_below: Annotated[int, Range(0, 1000)] = 100
    epipolar: Weight | None = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        right = all(check.is_number(t, whole=True) and 0 <= t <= LAST_STEP for t in self.starts)
        if not self.starts or not right:
            raise ValueError(
                f"starts: got {self.starts!r}, expected timesteps of Stable Diffusion, in"
                f" [0, {LAST_STEP}], at least one"
            )


class DGE(Method):
    """Edit views together through key views, tune the splats on them, and repeat with other views.

    The views of a round are sorted by their angle and cut into batches. At every step one view of
    each batch is drawn as key view. The key views attend to each other's tokens; every view then
    takes the attention output of the key tokens that match its tokens near the epipolar line. Each
    round noises renders of the current splats and is guided by renders of the original splats.

    The authors' code also densifies the splats; here their number stays constant.

    Args:
        gaussians, cameras, instruction, options: see :func:`by_view`. All views' edits have one
            size.
        images: see :func:`by_view`; used for the segments and for the detail that an edit at a
            smaller size lacks. Guides are renders.
        editor: an InstructPix2Pix.
        settings: :class:`DGESettings`; the defaults if omitted.

    Raises:
        ValueError, InputError, RuntimeError: see :func:`by_view`.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.methods import DGESettings, dge
        >>> from attnwarp.trial import disc, view
        >>> quick = DGESettings(steps=1, iterations=1, perceptual=0)
        >>> views, editor = [view(0), view(1)], load_editor("small-plain")
        >>> result = dge(disc(), views, None, editor, "red", quick)
        >>> result.counters["network_rows"]  # one key view and two views, two branches each
        6
    """

    def __init__(self, work: Work, settings: DGESettings) -> None:
        work.takes("dge", "picture", InstructPix2Pix)
        work.one_size("dge")
        self.work, self.settings = work, settings
        rounds = range(len(parts_of(settings.iterations, settings.every)))
        work.starts_at(min(self._start(number) for number in rounds), "starts")

    def run(self, loop: Loop) -> None:
        """Draw views, edit them together, tune on them, and repeat with other views."""
        work, s = self.work, self.settings
        for number, iterations in enumerate(parts_of(s.iterations, s.every)):
            order = torch.randperm(len(work.sizes), generator=work.generator(VIEWS, number))
            views = by_angle(work.views.cameras, sorted(order[: s.views].tolist()))
            keys = sum(self._with_keys(number)) * len(chunks(views, s.batch))
            rows = (s.steps * len(views) + keys) * work.branches()
            loop.edit(number, views, partial(self.edit, number, views), rows=rows)
            loop.tune(number, views, iterations)

    def edit(
        self, number: int, group: Sequence[int], model: Gaussians, step: Callable[[], None]
    ) -> list[ViewEdit]:
        """Edit the views of a round from their noised renders."""
        work, s = self.work, self.settings
        editor: Any = work.editor
        timesteps = editor.schedule.published(self._start(number), s.steps, s.grid)
        (noised,) = editor.schedule.published(self._start(number), 1)
        cameras = [work.views.cameras[view] for view in group]
        batches = chunks(range(len(group)), s.batch)
        generator = work.generator(KEYS, number)
        drawn: list[list[str]] = []
        with work.guided(s.text_guidance), torch.no_grad():
            guides = [work.render(view, work.frozen) for view in group]
            task = editor.task(guides, work.instruction, work.regions(group))
            before = editor.encode([work.render(view, model) for view in group])
            noise = work.noise(number, group).to(before)
            x = editor.schedule.add_noise(before, noise, noised)
            with key_views(
                editor.unet, task.branches, (x.shape[2], x.shape[3]), s.epipolar
            ) as attention:
                for (now, then), with_keys in zip(
                    following(timesteps), self._with_keys(number), strict=True
                ):
                    outputs = []
                    if with_keys:
                        keys = [_drawn(batch, generator) for batch in batches]
                        drawn.append([cameras[key].name for key in keys])
                        key_cameras = [cameras[key] for key in keys]
                        with attention.key_pass():
                            _part(task, keys).predict(x[keys], now)
                    for place, batch in enumerate(batches):
                        views, part = list(batch), _part(task, batch)
                        if not with_keys:
                            outputs.append(part.predict(x[views], now))
                            continue
                        nearest = 1 if place == 0 else 2
                        of_batch = [cameras[view] for view in views]
                        with attention.view_pass(of_batch, key_cameras, nearest):
                            outputs.append(part.predict(x[views], now))
                    x = editor.schedule.step(torch.cat(outputs), x, now, then)
                    step()
            pictures = editor.decode(x)
        about = {"start": self._start(number), "timesteps": timesteps, "keys": drawn}
        return [ViewEdit(picture, about) for picture in pictures]

    def _start(self, number: int) -> int:
        """Stable Diffusion timestep at which a round starts."""
        starts = self.settings.starts
        return starts[min(number, len(starts) - 1)]

    def _with_keys(self, number: int) -> list[bool]:
        """Flags of a round's steps: True if views take the key views' outputs at the step."""
        s = self.settings
        published = published_steps(self._start(number), s.steps, s.grid)
        return [timestep >= s.plain_below for timestep in published]


dge = door(
    DGE,
    {
        "default": DGESettings(),
        "released": DGESettings(text_guidance=7.5, image_guidance=1.5, grid="scheduler"),
    },
)


def by_angle(cameras: Sequence[Camera], views: Sequence[int]) -> list[int]:
    """Sort views by the angle of their direction to the leftmost camera's (smallest x).

    Angles cover the full circle and increase toward that camera's nearest neighbour.
    """
    forwards = {view: cameras[view].forward for view in views}
    first = min(views, key=lambda view: float(cameras[view].position[0]))

    def angle(view: int) -> float:
        sine = np.linalg.norm(np.cross(forwards[first], forwards[view]))
        return float(np.arctan2(sine, forwards[first] @ forwards[view]))

    apart = [view for view in views if 1e-9 < angle(view) < np.pi - 1e-9]
    if not apart:
        return sorted(views, key=angle)
    axis = np.cross(forwards[first], forwards[min(apart, key=angle)])

    def signed(view: int) -> float:
        ahead = axis @ np.cross(forwards[first], forwards[view]) >= 0
        return angle(view) if ahead else 2 * np.pi - angle(view)

    return sorted(views, key=signed)


def _drawn(batch: Sequence[int], generator: torch.Generator) -> int:
    return batch[int(torch.randint(len(batch), (1,), generator=generator))]


def _part(task: Any, views: Sequence[int]) -> Any:
    """Restrict an InstructPix2Pix task to some of its views."""
    rows = [branch * task.views + view for branch in range(len(task.branches)) for view in views]
    region = None if task.region is None else task.region[list(views)]
    return replace(
        task, text=task.text[rows], before=task.before[rows], views=len(views), region=region
    )
