"""The run of a baseline: rounds of edits and tuning, resumed after a kill, within a budget.

manifest.json         method, settings, rounds, hashes of the inputs
rounds/N/NAME.png     each edited view of a round; NAME.json: what its edit was
rounds/N.pt           the splats after the round's tuning, with their optimiser
views/NAME.png        the last edit of each view
renders/before/ after/  the scene from every view
sheet.png             both and the edits, side by side
cut.json              the budget's limit that ended the run, and its place; absent if none did
edited.ply  result.json  times.json  the edited splats; counters; seconds by part
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from attnwarp import check
from attnwarp.baselines.fitting import Fitting
from attnwarp.baselines.settings import BaselineSettings, Budget
from attnwarp.baselines.work import Method, Work
from attnwarp.camera import Camera
from attnwarp.editing.editor import Editor
from attnwarp.editing.schedule import START_PROTOCOL
from attnwarp.fit import compile_kernels
from attnwarp.gaussians import Gaussians
from attnwarp.io import write_ply
from attnwarp.propagate.folder import Folder, results_in
from attnwarp.propagate.pictures import Bytes, enlarged, full_size, resized, to_bytes
from attnwarp.propagate.progress import Step
from attnwarp.propagate.scene import (
    Scene,
    Segments,
    check_cameras,
    check_loaded,
    editor_digest,
    near_of,
    render_picture,
)
from attnwarp.propagate.times import Times
from attnwarp.propagate.tune import DrawnViews, TrainingView

FOLDERS = ("rounds", "views", "renders/before", "renders/after")

BUDGETED = ("edit", "tune")
"""Parts of the seconds that a budget limits; files and renders are for people."""

SHEET_VIEWS = 8
"""Views on the sheet, evenly spread."""


class Options(TypedDict, total=False):
    """What every baseline takes by name.

    Args:
        folder: of all results, created if need be; one that another run writes to is refused. A
            killed run resumes from it. All files but ``times.json`` then get the bytes of an
            uninterrupted run, on one machine, with the same number of threads and without a budget
            in seconds.
        budget: limits of the run, :class:`Budget`; None for a whole run.
        segments: what is edited: (H, W) bool masks of the views, or a function of a view's number
            and picture. The original stays outside.
        checkpoint_seconds: between two checkpoints of tuning (30).
        backend: of :func:`attnwarp.render.render` ("auto").
        watch: told how the run stands,
            :func:`attnwarp.propagate.progress.progress_display`.

    Example:
        >>> from attnwarp.baselines import Budget, Options
        >>> Options(budget=Budget(seconds=600))["budget"].seconds
        600
    """

    folder: Path | str | None
    budget: Budget | None
    segments: Segments | None
    checkpoint_seconds: float
    backend: str
    watch: Callable[[Step], object] | None


@dataclass(frozen=True, eq=False)
class Baseline:
    """The result of a baseline.

    Attributes:
        method: its name.
        gaussians: the edited splats, float32, outside autograd.
        edited: (h, w, 3) uint8 sRGB by the view's number: its last edit, at the size of the
            editor's work.
        counters: "network_rows" (rows through the UNet), "edits", "views" (edited at least once),
            "rounds" (begun), "iterations" of tuning, "splats".
        seconds: by part, over all sittings.
        cut: "seconds" or "network_rows" where that limit of the budget ended the run; None for a
            whole run.

    Example:
        >>> import numpy as np, torch
        >>> from attnwarp import Gaussians
        >>> from attnwarp.baselines import Baseline
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
        >>> edited = {0: np.zeros((8, 8, 3), np.uint8)}
        >>> Baseline("dge", disc, edited, {"views": 1}, {"edit": 2.5, "tune": 4.0}).cut is None
        True
    """

    method: str
    gaussians: Gaussians
    edited: dict[int, Bytes]
    counters: dict[str, int]
    seconds: dict[str, float]
    cut: str | None = None


@dataclass(frozen=True)
class Kind:
    """A method: its name, its settings, and how it is made for a work."""

    name: str
    settings: type[BaselineSettings]
    make: Callable[[Work, Any], Method]


def run(
    kind: Kind,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]] | None,
    editor: Editor,
    instruction: str,
    settings: BaselineSettings | None,
    **options: Unpack[Options],
) -> Baseline:
    """Run a method; the other arguments as of :func:`attnwarp.baselines.by_view`."""
    for option in options:
        check.one_of(option, list(Options.__annotations__), "option")
    chosen = kind.settings() if settings is None else settings
    if not isinstance(chosen, kind.settings):
        raise ValueError(
            f"settings: {kind.name} takes {kind.settings.__name__}, got {type(chosen).__name__}"
        )
    check.instance(gaussians, Gaussians, "gaussians", "attnwarp.Gaussians")
    check_loaded(editor)
    cameras = check_cameras(cameras)
    if options.get("budget") is not None:
        check.instance(options["budget"], Budget, "budget", "attnwarp.baselines.Budget")
    if not instruction.strip():
        raise ValueError("instruction: is empty, expected words such as 'make it red'")
    backend, folder = options.get("backend", "auto"), options.get("folder")
    if images is None:
        near = near_of(cameras, gaussians)
        images = [render_picture(gaussians, camera, near, backend) for camera in cameras]
    scene = Scene.checked(cameras, images, options.get("segments"))
    work = Work(gaussians, scene, editor, instruction, chosen, backend)
    method = kind.make(work, chosen)
    with results_in(folder) as place:
        return _Run(kind.name, method, work, place, options).go()


class _Run:
    """A run in progress. What is done stands in the folder; nothing else is remembered."""

    def __init__(
        self, name: str, method: Method, work: Work, folder: Path, options: Options
    ) -> None:
        self.name, self.method, self.work = name, method, work
        self.budget = options.get("budget") or Budget()
        self.checkpoint_seconds = options.get("checkpoint_seconds", 30.0)
        check.seconds(self.checkpoint_seconds, "checkpoint_seconds")
        self.watch = options.get("watch")
        rounds = range(1, len(method.rounds) + 1)
        folders = (*FOLDERS, *(f"rounds/{number}" for number in rounds))
        self.folder = Folder(folder, work.scene.cameras, folders)
        self.names = self.folder.names
        self.fitting = Fitting(work.frozen, work.scene.cameras, work.settings, work.backend)
        tuned = sorted({view for part in method.rounds for view in part.training})
        self.fitting.check_sizes(
            [work.scene.cameras[view] for view in tuned],
            None if work.settings.detail == "change" else [work.sizes[view] for view in tuned],
        )
        self.times = Times(self.folder)
        self.done, self.rows, self.edits = 0, 0, 0
        self.latest: dict[int, int] = {}
        self.total = sum(
            len(part.views) * work.settings.steps + part.iterations for part in method.rounds
        )
        settings = work.settings.to_dict()
        noised = settings.get("start") or settings.get("starts")
        self.folder.claim(
            {
                "method": name,
                "instruction": work.instruction,
                "settings": settings,
                **({"start_protocol": START_PROTOCOL} if noised else {}),
                "budget": asdict(self.budget),
                "rounds": [
                    {
                        "views": [self.names[view] for view in part.views],
                        "iterations": part.iterations,
                    }
                    for part in method.rounds
                ],
                "inputs": {
                    "splats": work.frozen.digest(),
                    **work.scene.digest(),
                    "editor": editor_digest(work.editor),
                    **self.fitting.weights,
                },
            }
        )

    def go(self) -> Baseline:
        for number in range(len(self.method.rounds)):
            if self._ended_before(number):
                break
            self._edit_round(number)
            # A round without an edit would tune on those before once more.
            if number in self.latest.values():
                self._tune_round(number)
        result = self._finish()
        cut = self.cut
        if cut is None:
            self._tell("done", done=self.total)
        else:
            self._tell(f"cut short by its {cut['limit'].replace('_', ' ')}")
        return result

    # --- budget

    @property
    def cut(self) -> dict[str, Any] | None:
        """Which limit ended the run, in which round; it stands in the folder, so that no later
        sitting goes beyond."""
        return self.folder.read_json("cut.json") if self.folder.has("cut.json") else None

    def _ended_before(self, number: int) -> bool:
        cut = self.cut
        return cut is not None and cut["round"] <= number

    def _edited_before_cut(self, number: int, place: int) -> bool:
        """Whether a group was edited before the cut: it is missing since its files are damaged."""
        cut = self.cut
        return cut is not None and (number + 1, place) < (cut["round"], cut["groups"])

    def _cut(self, limit: str, number: int, groups: int) -> None:
        """End the run in a round, of which so many groups are edited."""
        self.folder.write_json("cut.json", {"limit": limit, "round": number + 1, "groups": groups})

    def _out_of_seconds(self) -> bool:
        limit, seconds = self.budget.seconds, self.times.seconds
        return limit is not None and sum(seconds.get(part, 0.0) for part in BUDGETED) >= limit

    def _limit(self, rows: int) -> str | None:
        """The limit that forbids an edit of so many rows through the network."""
        if self._out_of_seconds():
            return "seconds"
        limit = self.budget.network_rows
        return "network_rows" if limit is not None and self.rows + rows > limit else None

    # --- editing

    def _edit_round(self, number: int) -> None:
        part = self.method.rounds[number]
        for place, group in enumerate(part.groups):
            rows = self.method.rows(number, group)
            if not all([self.folder.edited(self._picture(number, view)) for view in group]):
                limit = None if self.cut else self._limit(rows)
                if limit is not None:
                    self._cut(limit, number, place)
                # A run that was cut while it edited this round edits no further.
                if self.cut is not None and not self._edited_before_cut(number, place):
                    return
                self._edit_group(number, place, group)
            else:
                self.done += len(group) * self.work.settings.steps
            self.rows += rows
            self.edits += len(group)
            self.latest |= dict.fromkeys(group, number)

    def _edit_group(self, number: int, place: int, group: tuple[int, ...]) -> None:
        part = self.method.rounds[number]
        text = (
            f"round {number + 1} of {len(self.method.rounds)}: editing"
            f" {place + 1} of {len(part.groups)}"
        )
        # Rounds before are tuned by now: this is the current model.
        model = self.fitting.gaussians()
        with self.times.part("edit"):
            edits = self.method.edit(number, group, model, lambda: self._tell(text, len(group)))
        with self.times.part("write"):
            for view, edit in zip(group, edits, strict=True):
                pixels = to_bytes(self.work.composite(view, edit.picture))
                self.folder.write_edit(self._picture(number, view), pixels)
                about = {"view": self.names[view], "round": number + 1, **edit.about}
                # Last: a view counts as edited once this is there.
                self.folder.write_record(self._picture(number, view), about)
        self.times.write()

    def _picture(self, number: int, view: int) -> str:
        return f"rounds/{number + 1}/{self.names[view]}.png"

    def _edited(self, view: int) -> Bytes:
        """The last edit of a view."""
        return self.folder.read_picture(self._picture(self.latest[view], view))

    # --- tuning

    def _tune_round(self, number: int) -> None:
        begin = sum(part.iterations for part in self.method.rounds[:number])
        part = self.method.rounds[number]
        end, state = begin + part.iterations, f"rounds/{number + 1}.pt"
        if self.folder.has(state):
            self.fitting.restore(self.folder.path / state)
            self.done += self.fitting.iteration - begin
        training = [view for view in part.training if view in self.latest]
        cut = self.cut
        over = cut is not None and cut["limit"] == "seconds"
        if not training or over or (self.folder.has(state) and self.fitting.iteration >= end):
            return
        if self.work.backend in ("auto", "cpu"):
            compile_kernels(self.work.frozen.kind)  # not within the budget's seconds
        views = DrawnViews([partial(self._training, view, self._edited(view)) for view in training])
        text = f"round {number + 1} of {len(self.method.rounds)}: tuning"
        with self.times.part("tune"):
            self.fitting.advance(
                begin,
                end,
                views,
                checkpoint=self.folder.path / state,
                checkpoint_seconds=self.checkpoint_seconds,
                spent=self._out_of_seconds,
                watch=lambda: self._tell(f"{text}, loss {self.fitting.loss:.4f}", 1),
                saved=self.times.write,
            )
        if self.fitting.iteration < end:
            self._cut("seconds", number, len(part.groups))
        self.times.write()

    def _training(self, view: int, pixels: Bytes) -> TrainingView:
        camera = self.work.scene.cameras[view]
        edited = pixels.astype(np.float32) / np.float32(255)
        if self.work.settings.detail == "change":
            segments = self.work.scene.segments
            segment = None if segments is None else segments[view]
            picture = full_size(self.work.scene.picture(view), edited, segment, "original", 0.0)
            return TrainingView(view, camera, picture)
        h, w = self.work.sizes[view]
        return TrainingView(view, camera.resize(w, h), edited)

    # --- results

    def _finish(self) -> Baseline:
        final, cut = self.fitting.gaussians(), self.cut
        edited = {view: self._edited(view) for view in sorted(self.latest)}
        with self.times.part("render"):
            write_ply(self.folder.path / "edited.ply", final)
            for view, pixels in edited.items():
                self.folder.write_picture(f"views/{self.names[view]}.png", pixels)
            for part, model in (("before", self.work.frozen), ("after", final)):
                for camera, name in zip(self.work.scene.cameras, self.names, strict=True):
                    path = f"renders/{part}/{name}.png"
                    if not self.folder.has_picture(path):
                        picture = render_picture(model, camera, self.work.near, self.work.backend)
                        self.folder.write_picture(path, to_bytes(picture))
            self.folder.write_picture("sheet.png", self._sheet())
        counters = {
            "network_rows": self.rows,
            "edits": self.edits,
            "views": len(edited),
            "rounds": 1 + max(self.latest.values(), default=-1),
            "iterations": self.fitting.iteration,
            "splats": len(final),
        }
        tuned = {self.names[view]: n for view, n in sorted(self.fitting.visits.items())}
        limit = None if cut is None else cut["limit"]
        self.folder.write_json("result.json", {"counters": counters, "tuned": tuned, "cut": limit})
        self.times.write()
        return Baseline(self.name, final, edited, counters, self.times.seconds, limit)

    def _sheet(self) -> Bytes:
        """Rows: before, the edits (black where none), the edited scene. Columns: views."""
        count = len(self.names)
        views = (
            [k * count // SHEET_VIEWS for k in range(SHEET_VIEWS)]
            if count > SHEET_VIEWS
            else [*range(count)]
        )
        h, w = self.work.scene.images[views[0]].shape[:2]

        def tile(name: str) -> Bytes:
            if not self.folder.has(name):
                return np.zeros((h, w, 3), np.uint8)
            pixels = self.folder.read_picture(name)
            if pixels.shape[0] < h:
                return enlarged(pixels, (h, w))
            return to_bytes(resized(pixels.astype(np.float32) / np.float32(255), (h, w)))

        rows = [
            np.concatenate([tile(f"{part}/{self.names[view]}.png") for view in views], axis=1)
            for part in ("renders/before", "views", "renders/after")
        ]
        return np.concatenate(rows)

    # --- progress

    def _tell(self, text: str, steps: int = 0, *, done: int | None = None) -> None:
        self.done = self.done + steps if done is None else done
        if self.watch is not None:
            self.watch(Step(min(self.done, self.total), self.total, text))
