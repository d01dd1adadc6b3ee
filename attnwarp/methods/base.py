"""Loop of a method: edits and tuning, resumable after a kill, within a budget.

manifest.json         method, settings, rounds, hashes of the inputs
rounds/N/NAME.png     edited view of a round; NAME.json: its record
rounds/N.pt  N.ply    splats after the round's tuning, with and without their optimiser
masks/                pixels that took injected features (attention warping)
segments/             edited region of each view, if segments are given
views/NAME.png        last edit of each view
renders/before/ after/  renders of the scene from every view
cut.json              budget limit that ended the run, and its round; absent if no limit did
edited.ply, result.json, times.json: splats; change, drift, counters, Edit PSNR; seconds by part
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from attnwarp import check, losses
from attnwarp.camera import Camera
from attnwarp.devices import on_cpu_unless_named, with_gradients
from attnwarp.editing.editor import Editor
from attnwarp.editing.identity import editor_digest
from attnwarp.encoders import load_encoder
from attnwarp.fit import Views, compile_kernels
from attnwarp.fit.views import Drawn
from attnwarp.gaussians import Gaussians
from attnwarp.io import write_ply
from attnwarp.io.names import file_stems
from attnwarp.methods.change import MOST_DRIFTS, Change, change_of, drift_of, say_little
from attnwarp.methods.pictures import (
    Bytes,
    Image,
    full_size,
    to_bytes,
)
from attnwarp.methods.scene import (
    Segments,
    check_cameras,
    check_loaded,
    checked_segments,
    digests,
    near_of,
    render_picture,
)
from attnwarp.methods.settings import MethodSettings
from attnwarp.methods.tuning import HELD_BYTES, Order, Tuning
from attnwarp.methods.work import Work
from attnwarp.reporting import PACE_SECONDS, SILENT, Reporter, duration
from attnwarp.workdir import Budget, CheckpointClock, Workdir, results_in

FOLDERS = ("rounds", "masks", "segments", "views", "renders/before", "renders/after")

VIEWER_PLY = "edited-3dgs.ply"
"""Edited 2D splats as thin 3D splats, for viewers of 3DGS; the command writes this file."""

RESULTS = ("edited.ply", VIEWER_PLY, "result.json")
"""Result files in the manifest's folder."""

BUDGETED = ("warp", "edit", "tune")
"""Timed parts that count toward a budget; writing files and renders does not."""


class Options(TypedDict, total=False):
    """Options that every method takes by name.

    Args:
        folder: path of all results, created if missing; a folder that another run is writing to is
            refused. A killed run resumes from it. All files but ``times.json`` then get the bytes
            of an uninterrupted run, on one machine, with the same number of threads and without a
            budget in seconds.
        budget: limits of the run, :class:`Budget`; None for a complete run.
        segments: masks of the edited parts: (H, W) masks of the views, bool or soft in [0, 1], or a
            function of a view's number and picture. Pixels outside keep the original.
        masks: (H, W) bool of each view, or None: False where its picture shows what the scene
            lacks, such as a passer-by. Tuning ignores those pixels, and no features come from them.
        exposures: (3, 4) change of colour of each view, or None, see
            :class:`attnwarp.fit.Views`; its picture is compared with a render so changed.
        tune_outside: True tunes all splats alike. False (default) scales each splat's steps by its
            membership in the segments, so that the rest stays.
        checkpoint_seconds: time between checkpoints of tuning (30); longer if writing one is slow.
        backend: renderer name, as for :func:`attnwarp.render.render` ("auto").
        report: receiver of progress, :class:`attnwarp.reporting.Reporter`.
        written: function that is called after the edits of views are written to the folder.
        asked: further options of the user's command, by name, for the manifest.
        load: loader of the perceptual distance, :func:`attnwarp.encoders.load_encoder`. A caching
            loader can serve several runs.

    Example:
        >>> from attnwarp.methods import Budget, Options
        >>> Options(budget=Budget(seconds=600))["budget"].seconds
        600.0
    """

    folder: Path | str | None
    budget: Budget | None
    segments: Segments | None
    masks: Sequence[npt.NDArray[np.bool_] | None]
    exposures: Sequence[npt.NDArray[np.floating[Any]] | None]
    tune_outside: bool
    checkpoint_seconds: float
    backend: str
    report: Reporter
    written: Callable[[], None]
    asked: dict[str, Any]
    load: Callable[..., Any]


@dataclass(frozen=True)
class Round:
    """Round of a method: edit views, then tune the splats on edited views.

    Attributes:
        views: numbers of the views the round edits, in the order of editing.
        training: numbers of the views the round tunes on.
        iterations: iterations of tuning.
        rows: rows through the UNet for the round's edits.

    Example:
        >>> from attnwarp.methods import Round
        >>> Round(views=(0, 2), training=(0, 2), iterations=300).views
        (0, 2)
    """

    views: tuple[int, ...] = ()
    training: tuple[int, ...] = ()
    iterations: int = 0
    rows: int = 0


@dataclass(frozen=True, eq=False)
class Result:
    """Result of a method.

    Attributes:
        method: name of the method.
        gaussians: the edited splats, float32, outside autograd.
        edited: last edit of each view, (h, w, 3) uint8 sRGB at the editor's working size, by the
            view's number in the order of editing.
        rounds: planned views of each round.
        edit_psnr: dB: "pooled" (of the mean squared error over views), "mean" (of the views'
            PSNRs), and "views", the names of the counted views.
        counters: "network_rows" (rows through the UNet), "edits", "views" (edited at least once),
            "rounds" (begun), "iterations" of tuning, "splats", and the method's additional
            counters.
        seconds: time by part, summed over all processes of the run.
        cut: budget limit that ended the run, "seconds" or "network_rows"; None for a complete
            run.
        change: dE00 inside the mask: of the "scene", net of what tuning alone changes, and of
            the "source view", or of the "edited views" by a method without a source.
        drift: "view" and "drift": how the edit of the source, or of the view that moved most,
            shifts, scales and turns the picture, see :class:`attnwarp.drift.Drift`, or why this
            can't be told, see :class:`attnwarp.drift.NoDrift`.

    Example:
        >>> import numpy as np
        >>> from attnwarp.methods import Result
        >>> from attnwarp.trial import disc
        >>> edited = {0: np.zeros((8, 8, 3), np.uint8)}
        >>> Result("dge", disc(), edited, (), {}, {"views": 1}, {"edit": 2.5}).cut is None
        True
    """

    method: str
    gaussians: Gaussians
    edited: dict[int, Bytes]
    rounds: tuple[Round, ...]
    edit_psnr: dict[str, Any]
    counters: dict[str, float]
    seconds: dict[str, float]
    cut: str | None = None
    change: Change = field(default_factory=dict)
    drift: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ViewEdit:
    """Edited view with its record.

    Attributes:
        picture: (h, w, 3) in [0, 1].
        about: description of the edit, for its record.
        pictures: (H, W, 3) uint8 pictures for inspection, by their target folder.
    """

    picture: Image
    about: dict[str, Any] = field(default_factory=dict)
    pictures: dict[str, Bytes] = field(default_factory=dict)


Edit = Callable[[Gaussians, Callable[[], None]], list[ViewEdit]]
"""Function that edits views, from the current splats and a callback for each denoising step."""


class Loop(Protocol):
    """Steps of a method, executed in the order in which its ``run`` calls them."""

    def edit(self, number: int, views: Sequence[int], edit: Edit, *, rows: int) -> None:
        """Edit views together.

        Args:
            edit: function that makes the edits; not called for edits already in the folder.
        """
        ...

    def tune(
        self, number: int, views: Sequence[int], iterations: int, order: Order | None = None
    ) -> None:
        """Tune the splats on edited views.

        Args:
            views: numbers of the views to tune on; views without an edit are left out.
        """
        ...


class Method(ABC):
    """A method of editing a scene.

    Attributes:
        about: additional JSON of the run's manifest.
        inputs: SHA-256 of additional inputs, by name.
        notes: lines reported to the user at the start.
        psnr_leaves_out: numbers of the views that Edit PSNR excludes.
    """

    about: dict[str, Any] = {}  # noqa: RUF012  (never written to)
    inputs: dict[str, str | None] = {}  # noqa: RUF012
    notes: Sequence[str] = ()
    psnr_leaves_out: Collection[int] = ()

    @abstractmethod
    def run(self, loop: Loop) -> None:
        """Make all edits and all tuning through the loop. ``run`` is called twice, first to record
        the plan; if the second run's calls differ from the plan, RuntimeError ends the run.
        """

    def clear(self) -> None:  # noqa: B027  (most have nothing)
        """Remove temporary files of one process; called at its start and end."""

    def counters(self, records: dict[int, dict[str, Any]]) -> dict[str, float]:
        """Compute additional counters from the edits' records by view."""
        return {}


class Plan:
    """Loop that records a method's calls without executing them.

    Attributes:
        calls: list of edits and tunings, each with its round, views, and rows or iterations.
    """

    def __init__(self, method: Method) -> None:
        self.rounds: list[Round] = []
        self.calls: list[tuple[str, int, tuple[int, ...], int]] = []
        method.run(self)

    def edit(self, number: int, views: Sequence[int], edit: Edit, *, rows: int) -> None:
        """Plan an edit of views together."""
        self.calls.append(("edit", number, tuple(views), rows))
        now = self._round(number)
        self._change(number, views=(*now.views, *views), rows=now.rows + rows)

    def tune(
        self, number: int, views: Sequence[int], iterations: int, order: Order | None = None
    ) -> None:
        """Plan a round of tuning."""
        self.calls.append(("tune", number, tuple(views), iterations))
        self._change(number, training=tuple(views), iterations=iterations)

    def _round(self, number: int) -> Round:
        self.rounds += [Round()] * (number + 1 - len(self.rounds))
        return self.rounds[number]

    def _change(self, number: int, **changes: Any) -> None:
        self.rounds[number] = Round(**{**vars(self._round(number)), **changes})


@on_cpu_unless_named
@with_gradients
def run(
    name: str,
    make: Callable[[Work, Any], Method],
    kind: type[MethodSettings],
    /,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]] | None,
    editor: Editor,
    instruction: str,
    settings: MethodSettings | None = None,
    **options: Unpack[Options],
) -> Result:
    """Run a method; the other arguments are those of :func:`attnwarp.methods.by_view`."""
    for option in options:
        check.one_of(option, list(Options.__annotations__), "option")
    chosen = kind() if settings is None else settings
    check.instance(chosen, kind, "settings", f"attnwarp.methods.{kind.__name__}")
    check.instance(gaussians, Gaussians, "gaussians", "attnwarp.Gaussians")
    check_loaded(editor)
    cameras = check_cameras(cameras)
    if options.get("budget") is not None:
        check.instance(options["budget"], Budget, "budget", "attnwarp.methods.Budget")
    check.seconds(options.get("checkpoint_seconds", 30.0), "checkpoint_seconds")
    if not instruction.strip():
        raise ValueError("instruction: is empty, expected words such as 'make it red'")
    backend, folder = options.get("backend", "auto"), options.get("folder")
    if images is None:
        near = near_of(cameras, gaussians)
        images = [render_picture(gaussians, camera, near, backend) for camera in cameras]
    views = Views(cameras, images, options.get("masks", ()), options.get("exposures", ()))
    segments = checked_segments(options.get("segments"), views)
    with results_in(folder) as place:
        work = Work(
            gaussians, views, editor, instruction, chosen, backend,
            workdir_of(place), options.get("report", SILENT), segments,
        )  # fmt: skip
        return _Run(name, make(work, chosen), work, options).go()


def workdir_of(path: Path) -> Workdir:
    """Open the folder of a method's run."""
    return Workdir(path, "an edit", FOLDERS, RESULTS)


def edit_file(number: int, name: str) -> str:
    """Path in the run's folder of a view's edit; rounds count from 0."""
    return f"rounds/{number + 1}/{name}.png"


class _Run:
    """Run in progress: the loop that executes each step or skips a finished one."""

    def __init__(self, name: str, method: Method, work: Work, options: Options) -> None:
        self.name, self.method, self.work, self.folder = name, method, work, work.folder
        self.budget = options.get("budget") or Budget()
        self.clock = CheckpointClock(options.get("checkpoint_seconds", 30.0))
        self.names = file_stems(work.views.cameras)
        self.seconds = self.folder.seconds
        self.written = options.get("written", lambda: None)
        plan = Plan(method)
        self.rounds, self.planned = tuple(plan.rounds), iter(plan.calls)
        bound = work.segments is not None and work.settings.composite == "original"
        self.bound = bound and not options.get("tune_outside", False)
        self.tuning = Tuning(
            work.frozen, work.views.cameras, work.settings,
            sum(part.iterations for part in self.rounds), work.backend,
            work.membership() if self.bound else None, options.get("load", load_encoder),
        )  # fmt: skip
        tuned = sorted({view for part in self.rounds for view in part.training})
        self.tuning.check_sizes([work.views.cameras[view] for view in tuned])
        self.rows, self.edits = 0, 0
        self.latest: dict[int, int] = {}  # round of each view's last edit
        self.places = [0] * len(self.rounds)  # groups edited so far in each round
        self.done = {"edit": 0, "tune": 0}  # steps of denoising, iterations of tuning
        self.total = {
            "edit": sum(len(part.views) for part in self.rounds) * work.settings.steps,
            "tune": sum(self.tuning.steps(len(p.training), p.iterations) for p in self.rounds),
        }
        self.folder.folders = (
            *FOLDERS, *(f"rounds/{number + 1}" for number in range(len(self.rounds))),
        )  # fmt: skip
        self.folder.claim(
            {
                "method": name,
                "instruction": work.instruction,
                "settings": work.settings.to_dict(),
                "budget": self.budget.to_dict(),
                **({"tuned": "what is marked"} if self.bound else {}),
                **({"options": options["asked"]} if "asked" in options else {}),
                **method.about,
                "rounds": [
                    {
                        "views": [self.names[view] for view in part.views],
                        "iterations": part.iterations,
                    }
                    for part in self.rounds
                ],
                "inputs": {
                    "splats": work.frozen.digest(),
                    **digests(work.views, work.segments),
                    "editor": editor_digest(work.editor),
                    **self.tuning.weights,
                    **method.inputs,
                },
            }
        )

    def go(self) -> Result:
        # Only after the claim: the folder of another run says nothing about this run.
        for line in self.method.notes:
            self.work.report.log(line)
        self._write_segments()
        self.method.clear()
        self.method.run(self)
        self._follow(None)
        self.method.clear()
        result = self._finish()
        if self.cut is None:
            self.done = self.total
            self._tell("done")
        else:
            self._tell(f"cut short by its {self.cut['limit'].replace('_', ' ')}")
        return result

    def _follow(self, call: tuple[str, int, tuple[int, ...], int] | None) -> None:
        """Raise RuntimeError unless a call is the plan's next; None means the end."""
        planned = next(self.planned, None)
        if call != planned:
            raise RuntimeError(
                f"{self.name}: its run calls {call or 'nothing more'}, planned was"
                f" {planned or 'nothing more'}; draw the same numbers each time that it is called"
            )

    # --- budget

    @property
    def cut(self) -> dict[str, Any] | None:
        """Limit that ended the run, and its round; kept in the folder, so a resumed run does not
        exceed it."""
        return self.folder.read_json("cut.json") if self.folder.has("cut.json") else None

    def _cut(self, limit: str, number: int, groups: int) -> None:
        """End the run in a round after a given number of edited groups."""
        self.folder.write_json("cut.json", {"limit": limit, "round": number, "groups": groups})

    def _out_of_seconds(self) -> bool:
        limit, seconds = self.budget.seconds, self.seconds.parts
        return limit is not None and sum(seconds.get(part, 0.0) for part in BUDGETED) >= limit

    def _limit(self, rows: int) -> str | None:
        """Find the budget limit that forbids an edit of ``rows`` rows through the network."""
        if self._out_of_seconds():
            return "seconds"
        limit = self.budget.network_rows
        return "network_rows" if limit is not None and self.rows + rows > limit else None

    # --- editing

    def edit(self, number: int, views: Sequence[int], edit: Edit, *, rows: int) -> None:
        """Edit views together, as :class:`Loop` specifies."""
        self._follow(("edit", number, tuple(views), rows))
        place = self.places[number]
        self.places[number] += 1
        if all([self.folder.made(self._picture(number, view)) for view in views]):
            self.done["edit"] += len(views) * self.work.settings.steps
        else:
            limit = None if self.cut else self._limit(rows)
            if limit is not None:
                self._cut(limit, number, place)
            # A run that hit its budget only re-edits files that were removed since.
            if self.cut is not None and (number, place) >= (self.cut["round"], self.cut["groups"]):
                return
            self._edit_now(number, views, edit)
        self.rows += rows
        self.edits += len(views)
        self.latest |= dict.fromkeys(views, number)

    def _edit_now(self, number: int, views: Sequence[int], edit: Edit) -> None:
        first = self.rounds[number].views.index(views[0])
        text = (
            f"round {number + 1} of {len(self.rounds)}: editing view {first + 1} of"
            f" {len(self.rounds[number].views)}"
        )
        # Earlier rounds are tuned by now, so this is the current model.
        model = self.tuning.gaussians()
        with self.seconds.part("edit"):
            edits = edit(model, lambda: self._tell(text, edit=len(views)))
        with self.seconds.part("write"):
            for view, result in zip(views, edits, strict=True):
                self._write_edit(number, view, result)
            self.written()
        self.seconds.write()

    def _write_edit(self, number: int, view: int, edit: ViewEdit) -> None:
        file = self._picture(number, view)
        pixels = to_bytes(self.work.composite(view, edit.picture))
        self.folder.check_same(file, pixels)  # before any other file is redrawn
        pictures = {f"{part}/{self.names[view]}.png": p for part, p in edit.pictures.items()}
        for name, picture in pictures.items():
            self.folder.write_picture(name, picture)
        about = {"view": self.names[view], "round": number + 1, **edit.about}
        source, place = self.method.about.get("source"), self.rounds[number].views.index(view)
        if source == self.names[view] or (source is None and place < MOST_DRIFTS):
            about["drift"] = drift_of(self.work, view, edit.picture)
        self.folder.write_record(file, pixels, {**about, "pictures": list(pictures)})

    def _picture(self, number: int, view: int) -> str:
        return edit_file(number, self.names[view])

    def _edited(self, view: int) -> Bytes:
        """Read the last edit of a view."""
        return self.folder.read_picture(self._picture(self.latest[view], view))

    # --- tuning

    def tune(
        self, number: int, views: Sequence[int], iterations: int, order: Order | None = None
    ) -> None:
        """Tune the splats, as :class:`Loop` specifies."""
        self._follow(("tune", number, tuple(views), iterations))
        cut = self.cut
        # A round without an edit would tune on earlier edits once more.
        edited = number in self.latest.values() or not self.rounds[number].views
        if (cut is not None and cut["round"] < number) or not edited:
            return
        begin = sum(part.iterations for part in self.rounds[:number])
        end, state = begin + iterations, f"rounds/{number + 1}.pt"
        if self.folder.has(state):
            self.tuning.restore(self.folder, state)
            self.done["tune"] += self.tuning.steps(len(views), self.tuning.iteration - begin)
        finished = self.folder.has(state) and self.tuning.iteration >= end
        training = [view for view in views if view in self.latest]
        if not training or (cut is not None and cut["limit"] == "seconds"):
            return
        if not finished:
            self._tune_now(number, training, begin, end, state, order)
        # Written each time, since an existing file may be incomplete.
        write_ply(self.folder.path / f"rounds/{number + 1}.ply", self.tuning.gaussians())
        self.seconds.write()

    def _tune_now(
        self,
        number: int,
        training: Sequence[int],
        begin: int,
        end: int,
        state: str,
        order: Order | None,
    ) -> None:
        text = f"round {number + 1} of {len(self.rounds)}: tuning"
        self._tell(text)
        if self.work.backend in ("auto", "cpu"):
            # Excluded from the budget's seconds.
            compile_kernels(self.work.frozen.kind, device=self.tuning.model.device)
        views = self._training(training)

        def step() -> None:
            lifting = self.tuning.iteration == begin
            what = "colours" if lifting else f"loss {self.tuning.loss:.4f}"
            self._tell(f"{text}, {what}", tune=1)
            # Lifting begins anew if killed.
            if begin < self.tuning.iteration < end and self.clock.due:
                with self.clock.saving():
                    self.folder.save(state, self.tuning.state())
                    self.seconds.write()

        with self.seconds.part("tune"):
            self.tuning.advance(
                begin, end, views, training, order, spent=self._out_of_seconds, step=step
            )
            self.folder.save(state, self.tuning.state())
        if self.tuning.iteration < end:
            self._cut("seconds", number, self.places[number])

    def _training(self, numbers: Sequence[int]) -> Views:
        """Collect views with their edits at full size, each made when it is drawn, to tune on."""
        of = self.work.views
        return Views.unchecked(
            [of.cameras[k] for k in numbers],
            Drawn([partial(self._target, k) for k in numbers], HELD_BYTES),
            [of.masks[k] for k in numbers],
            [of.exposures[k] for k in numbers],
        )

    def _target(self, view: int) -> Image:
        edited = self._edited(view).astype(np.float32) / np.float32(255)
        s, segments = self.work.settings, self.work.segments
        segment = None if segments is None else segments[view]
        original = self.work.views.picture(view)
        return full_size(original, edited, segment, s.composite, s.composite_blur)

    # --- results

    def _finish(self) -> Result:
        final, cut = self.tuning.gaussians(), self.cut
        edited = {view: self._edited(view) for view in self.latest}
        with self.seconds.part("render"):
            write_ply(self.folder.path / "edited.ply", final)
            for view, pixels in edited.items():
                self.folder.write_picture(f"views/{self.names[view]}.png", pixels)
            for part, model in (("before", self.work.frozen), ("after", final)):
                for camera, name in zip(self.work.views.cameras, self.names, strict=True):
                    path = f"renders/{part}/{name}.png"
                    if not self.folder.has(path):
                        picture = render_picture(model, camera, self.work.near, self.work.backend)
                        self.folder.write_picture(path, to_bytes(picture))
            psnr = self._edit_psnr(final)
            change = change_of(self.work, self.names, self.method.about.get("source"), edited)
        records = {
            view: self.folder.record(self._picture(number, view))
            for view, number in self.latest.items()
        }
        drifts = {
            record["view"]: record["drift"] for record in records.values() if "drift" in record
        }
        moved = max(
            drifts, key=lambda name: (drifts[name] or {"largest": -1.0})["largest"], default=""
        )
        drift = {"view": moved, "drift": drifts.get(moved)}
        counters = {
            "network_rows": self.rows,
            "edits": self.edits,
            "views": len(edited),
            "rounds": 1 + max(self.latest.values(), default=-1),
            "iterations": self.tuning.iteration,
            "splats": len(final),
            **self.method.counters(records),
        }
        tuned = {self.names[view]: n for view, n in sorted(self.tuning.visits.items())}
        limit = None if cut is None else cut["limit"]
        about = {"edit_psnr": psnr, "counters": counters, "tuned": tuned, "cut": limit}
        said = {"change": change, "advice": say_little(change), "drift": drift}
        self.folder.write_json("result.json", {**said, **about})
        self.seconds.write()
        return Result(
            self.name,
            final,
            edited,
            self.rounds,
            psnr,
            counters,
            self.seconds.parts,
            limit,
            change,
            drift,
        )

    def _edit_psnr(self, final: Gaussians) -> dict[str, Any]:
        """PSNR of renders against edits: pooled from the mean MSE, and mean of finite PSNRs."""
        views = [view for view in self.latest if view not in self.method.psnr_leaves_out]
        errors = []
        for view in views:
            picture, kept = self.work.render(view, final, full=True), self.work.views.masks[view]
            squared = np.square(picture.astype(np.float64) - self._target(view))
            errors.append(float((squared if kept is None else squared[kept]).mean()))
        finite = [v for v in map(losses.psnr_of_mse, errors) if np.isfinite(v)]
        pooled = losses.psnr_of_mse(sum(errors) / len(errors)) if errors else np.inf
        return {
            "pooled": pooled if np.isfinite(pooled) else None,
            "mean": sum(finite) / len(finite) if finite else None,
            "views": [self.names[view] for view in views],
        }

    def _write_segments(self) -> None:
        for name, segment in zip(self.names, self.work.segments or (), strict=False):
            path = f"segments/{name}.png"
            if not self.folder.has(path):
                share = np.repeat(segment[..., None].astype(np.float32), 3, axis=2)
                self.folder.write_picture(path, to_bytes(share))

    # --- progress

    def _tell(self, text: str, **steps: int) -> None:
        """Report finished steps, and the views that are left to edit; the seconds left once both
        kinds of steps have shown their pace, as a step of denoising may take as long as many
        iterations, and those of editing before.
        """
        seconds, left = self.seconds.parts, dict.fromkeys(self.total, 0.0)
        for part, total in self.total.items():
            done = self.done[part] = min(self.done[part] + steps.get(part, 0), total)
            if done < total:
                spent = seconds.get(part, 0.0) if done else 0.0
                left[part] = (total - done) * spent / done if spent >= PACE_SECONDS else math.nan
        views = sum(len(part.views) for part in self.rounds) - self.edits
        if views and self.cut is None:
            text += f"; {views} view{'s' * (views > 1)} to edit"
            if math.isnan(left["tune"]) and left["edit"] > 0:
                text += f" in {duration(left['edit'])}"
        count = sum(self.done.values())
        self.work.report.step(count, sum(self.total.values()), text, sum(left.values()))
