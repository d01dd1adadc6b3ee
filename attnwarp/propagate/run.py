"""Algorithm 1: an edit of one view is carried into the others, and the scene is tuned on them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from numbers import Integral
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import check, losses
from attnwarp.camera import Camera
from attnwarp.digest import digest, digest_each
from attnwarp.editing.attention import Layer, Recording
from attnwarp.editing.editor import Editor, side_multiple
from attnwarp.editing.inversion import inversion_steps
from attnwarp.editing.schedule import FRESH_PROTOCOL, START_PROTOCOL
from attnwarp.gaussians import Gaussians
from attnwarp.io import write_ply
from attnwarp.propagate.editing import Guide, Source, Store, Target, ViewEditor
from attnwarp.propagate.folder import MANIFEST, SEGMENTS_FOLDER, Folder, record_of, results_in
from attnwarp.propagate.pictures import (
    Bytes,
    Image,
    Mask,
    Principal,
    check_view_aspect,
    composite,
    edit_size,
    enlarged,
    full_size,
    mask_picture,
    resized,
    sight_picture,
    to_bytes,
)
from attnwarp.propagate.progress import Step
from attnwarp.propagate.scene import (
    Scene,
    Segments,
    check_cameras,
    check_loaded,
    checked_image,
    editor_digest,
    near_of,
    render_picture,
    to_float,
)
from attnwarp.propagate.settings import PRESETS, PropagateSettings
from attnwarp.propagate.sight import Sight
from attnwarp.propagate.stages import Plan, choose_chain
from attnwarp.propagate.times import Times
from attnwarp.propagate.tune import DrawnViews, TrainingView, Tuning
from attnwarp.warp import Surface, WarpedView, render_surface, warp_view

RECORDING = ".recording"
"""Folder of the recorded features while an edit with ``store="disk"`` is in progress."""

Watch = Callable[[Step], object]
Warps = Callable[[int, int], WarpedView]
"""The warp from a source view to a target view, by their numbers."""


@dataclass(frozen=True, eq=False)
class Propagation:
    """The result of :func:`propagate`.

    Attributes:
        gaussians: the edited splats, float32, outside autograd.
        plan: the views of each stage.
        edited: (h, w, 3) uint8 sRGB by the view's number, the source first, at the size of the
            editor's work.
        edit_psnr: dB: "pooled" (of the mean squared error over views), "mean" (of the views'
            PSNRs), and "views", the names that were counted.
        counters: "network_rows" (rows through the UNet), "feature_bytes", "iterations", "splats",
            "injected" (mean weight of the warped features over the targets' pixels, before a_t),
            "sources" where there are several.
        seconds: by part, over all sittings.

    Example:
        >>> import numpy as np, torch
        >>> from attnwarp import Gaussians
        >>> from attnwarp.propagate import Plan, Propagation
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
        >>> edited = {view: np.zeros((8, 8, 3), np.uint8) for view in (2, 0, 1)}
        >>> result = Propagation(disc, Plan(2, ((0,), (1,))), edited, {}, {}, {"edit": 2.5})
        >>> list(result.edited) == list(result.plan.edited)  # the source first
        True
    """

    gaussians: Gaussians
    plan: Plan
    edited: dict[int, Bytes]
    edit_psnr: dict[str, Any]
    counters: dict[str, float]
    seconds: dict[str, float]


def propagate(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[npt.NDArray[Any]] | None,
    editor: Editor,
    instruction: str,
    settings: PropagateSettings = PRESETS["corrected"],
    *,
    source: int = 0,
    source_picture: npt.NDArray[Any] | None = None,
    segments: Segments | None = None,
    warps: Warps | None = None,
    folder: Path | str | None = None,
    store: Literal["device", "cpu", "disk"] = "cpu",
    checkpoint_seconds: float = 30.0,
    backend: str = "auto",
    watch: Watch | None = None,
    announce: Callable[[str], None] | None = None,
) -> Propagation:
    """Edit one view of a scene, carry the edit into others, and tune the splats on all of them.

    The source view's edit is recorded once. Each stage then edits a random subset of the unedited
    views, with features of the source warped along the scene's geometry. At its end it tunes the
    splats on edited views.

    With ``folder``, every result is written there as soon as it exists
    (:mod:`attnwarp.propagate.folder` lists the files). A killed run resumes from it. On one
    machine, with the same number of threads, all files but ``times.json`` then get the bytes of an
    uninterrupted run. Edited views are rounded to 8 bits, with a folder or without.

    Args:
        gaussians: the scene before the edit, N splats of either kind.
        cameras: V views, at least one.
        images: V pictures (H, W, 3), sRGB, uint8, uint16 or floating in [0, 1]: the views before
            the edit. None takes renders of ``gaussians``.
        editor: see :mod:`attnwarp.editing`.
        instruction: an instruction or a prompt, as the editor takes it.
        settings: every choice of the method, see :class:`PropagateSettings`.
        source: number of the source view.
        source_picture: (h, w, 3) the source view edited elsewhere, such as by hand, of a type that
            ``images`` may have. It is resized to the editor's size, so it has the view's aspect
            ratio. Its features are recorded while its own noise is replayed (edit-friendly
            inversion).
        segments: what is edited: (H, W) bool masks of the views, or a function of a view's number
            and picture. See ``composite`` of the settings and ``segment`` of their warp.
        warps: the warp from the source to a target, by their numbers, such as one from exact depth;
            used in place of those from the splats' depth.
        folder: made if need be.
        store: of the recorded features: on the editor's "device", in main memory ("cpu"), or in
            the folder ("disk") until the edit is done.
        checkpoint_seconds: between two checkpoints of tuning.
        backend: of :func:`attnwarp.render.render`.
        watch: told how the edit stands, :func:`attnwarp.propagate.progress.progress_display`.
        announce: told what the views or the editor leave of the settings, and the memory of all
            recordings together before the first is made.

    Raises:
        ValueError: an argument of another size or of values that cannot be; the message names it.
        TypeError: an argument of another type, such as the name of an editor.
        InputError: the folder holds an edit of other settings or inputs, which the message names;
            or another run writes to it.
        RuntimeError: tuning diverged; the last checkpoint stays.

    Example:
        >>> import torch
        >>> from attnwarp import Camera, Gaussians
        >>> from attnwarp.editing.small import load_editor
        >>> from attnwarp.propagate import preset, propagate
        >>> disc = Gaussians("2d", torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]),
        ...                  torch.full((1, 2), 0.5), torch.ones(1), torch.zeros(1, 1, 3))
        >>> view = dict(width=32, height=32, fov_y=40, up=(0, 1, 0))
        >>> cameras = [Camera.look_at((x, 0, 3), (0, 0, 0), **view) for x in (0, 1)]
        >>> quick = preset("corrected", stages=1, steps=1, iterations=1)
        >>> result = propagate(disc, cameras, None, load_editor("small-plain"), "red", quick)
        >>> result.plan.stages, result.edited[1].shape
        (((1,),), (32, 32, 3))
    """
    check.instance(gaussians, Gaussians, "gaussians", "attnwarp.Gaussians")
    check.instance(settings, PropagateSettings, "settings", "PropagateSettings, as of preset()")
    check_loaded(editor)
    cameras = check_cameras(cameras)
    check.instance(source, Integral, "source", "a number of a view")
    if not 0 <= source < len(cameras):
        raise ValueError(f"source: got {source}, expected a number of a view below {len(cameras)}")
    check.one_of(store, ("device", "cpu", "disk"), "store")
    check.seconds(checkpoint_seconds, "checkpoint_seconds")
    if not instruction.strip():
        raise ValueError("instruction: is empty, expected words such as 'make it red'")
    if images is None:
        near = near_of(cameras, gaussians)
        images = [render_picture(gaussians, camera, near, backend) for camera in cameras]
    scene = Scene.checked(cameras, images, segments)
    by_hand = None
    if source_picture is not None:
        check.shape(np.asarray(source_picture), ("H", "W", 3), "source_picture")
        by_hand = to_float(checked_image(source_picture, "source_picture"))
        h, w, _ = by_hand.shape
        check_view_aspect((h, w), cameras[source], "source_picture")
        if settings.latents == "inversion":
            raise ValueError(
                "source_picture: got one with latents 'inversion', but its own noise is replayed;"
                " leave it out, or set latents to 'random'"
            )
    with results_in(folder) as place:
        run = _Run(
            gaussians, scene, editor, instruction, settings, source, by_hand, warps,
            place, store, checkpoint_seconds, backend, watch, announce,
        )  # fmt: skip
        return run.go()


class _Run:
    """An edit in progress. What is done stands in the folder; nothing else is remembered."""

    def __init__(
        self,
        gaussians: Gaussians,
        scene: Scene,
        editor: Editor,
        instruction: str,
        settings: PropagateSettings,
        source: int,
        by_hand: Image | None,
        warps: Warps | None,
        folder: Path,
        store: str,
        checkpoint_seconds: float,
        backend: str,
        watch: Watch | None,
        announce: Callable[[str], None] | None,
    ) -> None:
        self.frozen, self.scene, self.editor = gaussians.detach(), scene, editor
        self.settings, self.backend, self.watch = settings, backend, watch
        self.warps = warps
        self.checkpoint_seconds = checkpoint_seconds
        multiple = side_multiple(editor)
        self.sizes = [
            edit_size(camera.height, camera.width, settings.size, multiple)
            for camera in scene.cameras
        ]
        self.by_hand = None if by_hand is None else resized(by_hand, self.sizes[source])
        self.folder = Folder(folder, scene.cameras)
        self.names = self.folder.names
        disk = folder / RECORDING
        place: Store = disk if store == "disk" else "device" if store == "device" else "cpu"
        self.view_editor = ViewEditor(editor, instruction, settings, store=place, announce=announce)
        self.near = near_of(scene.cameras, gaussians)
        self._frozen_surfaces: dict[int, Surface] = {}
        self.times = Times(self.folder)
        self.plan = Plan.draw(len(scene.cameras), source, settings, self._chain(source))
        editing = [number for number, stage in enumerate(self.plan.stages) if stage]
        self.view_editor.check_batches(editing, further=bool(self.plan.chain))
        self.tuning = Tuning(
            gaussians, scene.cameras, settings, len(self.plan.stages), backend=backend
        )
        tuned = sorted({source, *self.plan.sources, *self.plan.edited})
        self.tuning.check_sizes(
            [scene.cameras[view] for view in tuned],
            None if settings.detail == "change" else [self.sizes[view] for view in tuned],
        )
        self.done = 0
        self.total = (
            len(self.plan.edited) * settings.steps + len(self.plan.stages) * settings.iterations
        )
        chain = self.plan.chain
        self.folder.claim(
            {
                "instruction": instruction,
                "settings": settings.to_dict(),
                **({"start_protocol": START_PROTOCOL} if settings.start else {}),
                **({"fresh_noise": FRESH_PROTOCOL} if settings.noise == "fresh" else {}),
                "source": self.names[source],
                **({"chain": [self.names[view] for view in chain]} if chain else {}),
                "stages": [[self.names[view] for view in stage] for stage in self.plan.stages],
                "inputs": {
                    "splats": gaussians.digest(),
                    **scene.digest(),
                    "editor": editor_digest(editor),
                    **self.tuning.weights,
                    "source_picture": None if by_hand is None else digest(by_hand),
                    **({} if warps is None else {"warps": self._warps_digest(warps)}),
                },
            }
        )
        # After the claim: in the folder of another edit nothing of this one is true.
        if announce is not None:
            self._announce_changes(announce, source, multiple)

    def _announce_changes(
        self, announce: Callable[[str], None], source: int, multiple: int
    ) -> None:
        asked, longest = self.settings, max(self.sizes[source])
        if asked.size is not None and longest != asked.size:
            announce(
                f"size: {longest} px in place of {asked.size}, as this editor's sides are multiples"
                f" of {multiple}"
            )
        if len(self.plan.sources) < asked.sources:
            announce(
                f"sources: {len(self.plan.sources)} in place of {asked.sources}, as there are"
                f" {len(self.scene.cameras)} views"
            )
        if len(self.plan.stages) < asked.stages:
            on_sources = "" if self.plan.stages[0] else " that tunes on the sources alone"
            announce(
                f"stages: {len(self.plan.stages)}{on_sources} in place of {asked.stages}, as"
                f" {len(self.scene.cameras)} views leave no more to edit"
            )

    def go(self) -> Propagation:
        self._clear_recording()  # of a sitting that was killed: it is never read again
        self._write_segments()
        self._edited_sources()
        for number, stage in enumerate(self.plan.stages):
            self._edit_stage(number, stage)
            self._tune_stage(number)
        self._clear_recording()
        result = self._finish()
        self._tell("done", done=self.total)
        return result

    def _write_segments(self) -> None:
        if self.scene.segments is None:
            return
        (self.folder.path / SEGMENTS_FOLDER).mkdir(exist_ok=True)
        for name, segment in zip(self.names, self.scene.segments, strict=True):
            path = f"{SEGMENTS_FOLDER}/{name}.png"
            if not self.folder.has_picture(path):
                self.folder.write_picture(path, mask_picture(torch.from_numpy(segment)))

    # --- editing

    def _chain(self, source: int) -> tuple[int, ...]:
        """Further sources; those of the folder's edit are not chosen again."""
        s = self.settings
        if s.sources == 1:
            return ()
        if self.folder.has(MANIFEST):
            names = self.folder.read_json(MANIFEST).get("chain", [])
            if set(names) <= set(self.names):  # else the claim refuses the folder
                return tuple(self.names.index(name) for name in names)
        segments = self.scene.segments

        def seen(first: int, target: int) -> tuple[Mask, Mask]:
            warp = self._warp(first, target, self.frozen)
            surface = warp.rules["defined"].numpy()
            return warp.mask.numpy(), surface if segments is None else surface & segments[target]

        with self.times.part("warp"):
            views = len(self.scene.cameras)
            return choose_chain(views, source, s.sources, s.chain_coverage, seen)

    def _edited_sources(self) -> None:
        finished = sum([self._is_edited(view) for view in self.plan.sources])
        self.done += finished * self.settings.steps
        if finished < len(self.plan.sources):
            _ = self.sources

    def _is_edited(self, view: int) -> bool:
        """Whether the folder has a view's edit, and what its record says was drawn with it."""
        picture = self._picture(view)
        record = record_of(picture)
        about = self.folder.read_json(record) if self.folder.has(record) else {}
        name = self.names[view]
        warped = (f"masks/{name}.png", f"features/{name}.png") if "rules" in about else ()
        recorded = ("features.png",) if about.get("feature_bytes") else ()
        return self.folder.edited(picture, *warped, *recorded)

    @cached_property
    def sources(self) -> list[Source]:
        """The sources' edits; made anew, to the same bytes, in each sitting that needs them."""
        sources: list[Source] = []
        self.view_editor.announce_recordings({v: self.sizes[v] for v in self.plan.sources})
        for view in self.plan.sources:
            sources.append(self._source(view, sources))
        return sources

    def _source(self, view: int, before: list[Source]) -> Source:
        name = self.names[view]
        text = f"editing the source, {name}" if not before else f"editing a further source, {name}"
        file = self._picture(view)
        stored = self._is_edited(view)
        # Edited again for its features, it is no progress.
        step = 0 if stored else 1
        sight = self._sight(view, self.frozen, len(before)) if before else None
        with self.times.part("source"):
            source = self.view_editor.source(
                self._target(view, self.frozen, sight),
                before,
                by_hand=None if before else self.by_hand,
                watch=lambda: self._tell(text, step),
            )
        if not before and source.recording is not None:
            _, features = self._shown(source.recording)
            self._principal = Principal(features)
        if stored:
            self.folder.check_edit(file, to_bytes(self._composite(view, source.picture)))
        elif before:
            self._write_view(0, view, source.picture, sight, before)
        else:
            self._write_source(view, source)
        return source

    def _write_source(self, view: int, source: Source) -> None:
        self.folder.write_edit("source.png", to_bytes(self._composite(view, source.picture)))
        if source.recording is not None:
            layer, features = self._shown(source.recording)
            size = layer.size(source.recording.plan.latent_size)
            picture = self._principal.picture(features, size)
            shape = self.scene.images[view].shape
            self.folder.write_picture("features.png", enlarged(picture, (shape[0], shape[1])))
        self.folder.write_record(
            "source.png",
            {
                "view": self.names[view],
                "branches": list(source.branches),
                "feature_bytes": 0 if source.recording is None else source.recording.plan.bytes,
            },
        )

    def _shown(self, recording: Recording) -> tuple[Layer, torch.Tensor]:
        """The layer whose features are shown as colours, and its (h w, C) features half-way
        through those that were recorded.
        """
        plan = recording.plan
        layer = min(plan.layers, key=lambda layer: (layer.level, layer.kind != "self"))
        numbers = sorted(plan.recorded)
        timestep = recording.timesteps[numbers[len(numbers) // 2]]
        return layer, recording.features(timestep, layer, plan.keep[0])[0].float()

    def _edit_stage(self, number: int, stage: tuple[int, ...]) -> None:
        for batch in self._batches(stage):
            if all([self._is_edited(view) for view in batch]):
                self.done += len(batch) * self.settings.steps
                continue
            self._edit_batch(number, stage, batch)

    def _batches(self, stage: tuple[int, ...]) -> Iterator[list[int]]:
        """Views that go through the network together: neighbours in the order, of one size."""
        batch: list[int] = []
        for view in stage:
            full = len(batch) == self.settings.batch
            if batch and (full or self.sizes[view] != self.sizes[batch[0]]):
                yield batch
                batch = []
            batch.append(view)
        if batch:
            yield batch

    def _edit_batch(self, number: int, stage: tuple[int, ...], batch: list[int]) -> None:
        sources = self.sources  # first, so that their time is not counted here
        # Stages before are tuned by now: this is the current model.
        model = self.tuning.gaussians()
        with self.times.part("warp"):
            sights = [self._sight(view, model, len(sources)) for view in batch]
        text = (
            f"stage {number + 1} of {len(self.plan.stages)}: editing view"
            f" {stage.index(batch[0]) + 1} of {len(stage)}"
        )
        targets = [
            self._target(view, model, sight) for view, sight in zip(batch, sights, strict=True)
        ]
        with self.times.part("edit"):
            pictures = self.view_editor.targets(
                sources, targets, number, watch=lambda: self._tell(text, len(batch))
            )
        with self.times.part("write"):
            for view, picture, sight in zip(batch, pictures, sights, strict=True):
                self._write_view(number + 1, view, picture, sight, sources)
        self.times.write()

    def _target(self, view: int, model: Gaussians, sight: Sight | None) -> Target:
        return Target(view, self._guide(view, model), self._start_picture(view, model), sight)

    def _write_view(
        self,
        stage: int,
        view: int,
        picture: Image,
        sight: Sight | None,
        sources: Sequence[Source],
    ) -> None:
        name = self.names[view]
        file, pixels = f"views/{name}.png", to_bytes(self._composite(view, picture))
        self.folder.check_edit(file, pixels)  # before anything is drawn anew beside it
        about: dict[str, Any] = {"view": name, "stage": stage, "injected": 0.0}
        recordings = [source.recording for source in sources if source.recording is not None]
        if sight is not None and recordings:
            rules = sight.views[0].rules
            about["injected"] = float(sight.weight.mean())
            about["rules"] = {k: float(rule.float().mean()) for k, rule in rules.items()}
            if len(sources) > 1:
                choice = sight.choice((sight.mask.shape[0], sight.mask.shape[1]))
                about["sources"] = {
                    self.names[source]: float((choice == number).float().mean())
                    for number, source in enumerate(self.plan.sources[: len(sources)])
                }
            self.folder.write_picture(f"masks/{name}.png", sight_picture(sight))
            self.folder.write_picture(
                f"features/{name}.png", self._warped_features(view, sight, recordings)
            )
        self.folder.write_edit(file, pixels)
        # Last: a view counts as edited once this is there.
        self.folder.write_record(file, about)

    def _warped_features(self, view: int, sight: Sight, recordings: Sequence[Recording]) -> Bytes:
        h, w = (side // self.editor.factor for side in self.sizes[view])
        parts = []
        for number, recording in enumerate(recordings):
            layer, features = self._shown(recording)
            size = layer.size((h, w))
            source_size = layer.size(recording.plan.latent_size)
            grid = sight.warp(number).at(size, source_size=source_size)
            warped = grid.warp_tokens(features[None].cpu())[0]
            parts.append(self._principal.picture(warped, size, grid.mask))
        # A pixel takes one source at most, and is black in the others' pictures.
        return enlarged(np.maximum.reduce(parts), self.scene.images[view].shape[:2])

    def _sight(self, view: int, model: Gaussians, sources: int) -> Sight | None:
        """How the first sources see a view; None where nothing is warped."""
        s = self.settings
        if s.method != "warp" and s.noise != "surface" and s.estimate == 0:
            return None
        chosen = self.plan.sources[:sources]
        warps = [self._warp(source, view, model) for source in chosen]
        scales = [self._edit_share(source) / self._edit_share(view) for source in chosen]
        margins = [self._margin(source) for source in chosen] if s.estimate_margin > 0 else None
        return Sight(warps, s.confidence, scales, margins)

    def _margin(self, source: int) -> int:
        """Pixels of a source's depth map at a depth edge whose picture is not warped."""
        camera = self.scene.cameras[source]
        return round(self.settings.estimate_margin * min(camera.height, camera.width))

    def _edit_share(self, view: int) -> float:
        """Pixels of a view's edit for each of its picture."""
        camera, (h, w) = self.scene.cameras[view], self.sizes[view]
        return h * w / (camera.height * camera.width)

    def _warp(self, source: int, target: int, model: Gaussians) -> WarpedView:
        """The warp from one view to another along a model, or along the one before the edit."""
        s = self.settings
        if self.warps is not None:
            return self._masked(self.warps(source, target))
        before = self.frozen if s.depth_from == "frozen" else model
        reads: dict[str, Any] = {}
        if s.warp.photometric is not None:
            reads["source_image"] = self.scene.picture(source)
            reads["target_image"] = self.scene.picture(target)
        if s.warp.segment and self.scene.segments is not None:
            reads["target_segment"] = self.scene.segments[target]
        warp = warp_view(
            before,
            self.scene.cameras[source],
            self.scene.cameras[target],
            s.warp,
            **reads,
            source_surface=self._surface(source, before),
            near=self.near,
            backend=self.backend,
            warn_empty=False,
        )
        return self._masked(warp)

    def _masked(self, warp: WarpedView) -> WarpedView:
        if self.settings.mask:
            return warp
        return replace(warp, mask=warp.rules["defined"].clone(), _at={})

    def _warps_digest(self, warps: Warps) -> str:
        """SHA-256 of every warp there may be: a function has no other identity."""
        pairs = [
            (source, target)
            for source in self.plan.sources
            for target in self.plan.edited
            if target != source
        ]

        def parts() -> Iterator[npt.NDArray[Any]]:
            # A warp is large, so none is kept; its mask is a hundredth of it.
            masks = []
            for source, target in pairs:
                warp, camera = warps(source, target), self.scene.cameras[target]
                name = f"warps({source}, {target}).mask"
                check.shape(warp.mask, (camera.height, camera.width), name)
                masks.append(warp.mask.numpy())
                yield warp.correspondence.xy.numpy()
            yield from masks

        return digest_each(parts())

    def _surface(self, view: int, model: Gaussians) -> Surface:
        if model is self.frozen and view in self._frozen_surfaces:
            return self._frozen_surfaces[view]
        camera = self.scene.cameras[view]
        surface = self._rendered_surface(model, camera)
        if model is self.frozen:
            self._frozen_surfaces[view] = surface
        return surface

    def _rendered_surface(self, model: Gaussians, camera: Camera) -> Surface:
        warp = self.settings.warp
        return render_surface(model, camera, warp, near=self.near, backend=self.backend)

    def _guide(self, view: int, model: Gaussians) -> Guide:
        if self.editor.guide == "picture":
            return resized(self.scene.picture(view), self.sizes[view])
        before = self.frozen if self.settings.depth_from == "frozen" else model
        h, w = self.sizes[view]
        camera = self.scene.cameras[view].resize(w, h)
        return np.asarray(self._rendered_surface(before, camera).depth)

    def _start_picture(self, view: int, model: Gaussians) -> Image | None:
        inverted = self.settings.latents == "inversion"
        if self.view_editor.timestep is None and not inverted:
            return None
        h, w = self.sizes[view]
        if inverted or self.settings.start_picture == "original":
            return resized(self.scene.picture(view), (h, w))
        return render_picture(model, self.scene.cameras[view].resize(w, h), self.near, self.backend)

    def _composite(self, view: int, picture: Image) -> Image:
        if self.scene.segments is None:
            return picture
        original = resized(self.scene.picture(view), self.sizes[view])
        s = self.settings
        return composite(
            picture, original, self.scene.segments[view], s.composite, s.composite_blur
        )

    # --- tuning

    def _tune_stage(self, number: int) -> None:
        s = self.settings
        state, splats = f"stages/{number + 1}.pt", f"stages/{number + 1}.ply"
        if self.folder.has(state):
            self.tuning.restore(self.folder.path / state)
            self.done += self.tuning.iteration - number * s.iterations
        end = (number + 1) * s.iterations
        finished = self.tuning.iteration >= end and self.folder.has(state)
        if not finished:
            text = f"stage {number + 1} of {len(self.plan.stages)}: tuning"
            training = self.plan.training(number, s.training)
            makers = [partial(self._training, view, self._edited(view)) for view in training]

            def tell() -> None:
                self._tell(f"{text}, loss {self.tuning.loss:.4f}", 1)

            with self.times.part("tune"):
                self.tuning.stage(
                    number,
                    DrawnViews(makers),
                    self._training(self.plan.source, self._edited(self.plan.source)),
                    checkpoint=self.folder.path / state,
                    checkpoint_seconds=self.checkpoint_seconds,
                    watch=tell,
                    saved=self.times.write,
                )
        if not (finished and self.folder.has_splats(splats)):
            write_ply(self.folder.path / splats, self.tuning.gaussians())
        self.times.write()

    def _training(self, view: int, pixels: Bytes) -> TrainingView:
        camera = self.scene.cameras[view]
        edited = pixels.astype(np.float32) / np.float32(255)
        s, segments = self.settings, self.scene.segments
        if s.detail == "change":
            segment = None if segments is None else segments[view]
            original = self.scene.picture(view)
            picture = full_size(original, edited, segment, s.composite, s.composite_blur)
            return TrainingView(view, camera, picture)
        h, w = self.sizes[view]
        return TrainingView(view, camera.resize(w, h), edited)

    def _picture(self, view: int) -> str:
        """The file of a view's edit."""
        return "source.png" if view == self.plan.source else f"views/{self.names[view]}.png"

    def _edited(self, view: int) -> Bytes:
        """A picture that this edit wrote earlier."""
        return self.folder.read_picture(self._picture(view))

    # --- what is left for people

    def _finish(self) -> Propagation:
        final = self.tuning.gaussians()
        with self.times.part("render"):
            write_ply(self.folder.path / "edited.ply", final)
            for part, model in (("before", self.frozen), ("after", final)):
                for camera, name in zip(self.scene.cameras, self.names, strict=True):
                    path = f"renders/{part}/{name}.png"
                    if not self.folder.has_picture(path):
                        pixels = to_bytes(render_picture(model, camera, self.near, self.backend))
                        self.folder.write_picture(path, pixels)
            psnr = self._edit_psnr(final)
        counters = self._counters(final)
        self.folder.write_json(
            "result.json",
            {
                "edit_psnr": psnr,
                "counters": counters,
                "tuned": {self.names[v]: n for v, n in sorted(self.tuning.visits.items())},
            },
        )
        self.times.write()
        edited = {view: self._edited(view) for view in self.plan.edited}
        return Propagation(final, self.plan, edited, psnr, counters, self.times.seconds)

    def _edit_psnr(self, final: Gaussians) -> dict[str, Any]:
        views = list(self.plan.edited)
        if self.settings.psnr_views == "before_last_stage" and len(self.plan.stages) > 1:
            views = [view for view in views if view not in self.plan.stages[-1]]
        errors = []
        for view in views:
            target = self._training(view, self._edited(view))
            picture = render_picture(final, target.camera, self.near, self.backend)
            errors.append(float(np.square(picture.astype(np.float64) - target.picture).mean()))
        each = [losses.psnr_of_mse(error) for error in errors]
        finite = [value for value in each if np.isfinite(value)]
        pooled = losses.psnr_of_mse(sum(errors) / len(errors))
        return {
            "pooled": pooled if np.isfinite(pooled) else None,
            "mean": sum(finite) / len(finite) if finite else None,
            "views": [self.names[view] for view in views],
        }

    def _counters(self, final: Gaussians) -> dict[str, float]:
        source = self.folder.read_json("source.json")
        targets = self.plan.targets
        shares = [
            self.folder.read_record(f"views/{self.names[view]}.png", "injected")["injected"]
            for view in targets
        ]
        sources = len(self.plan.sources)
        # An edit made by hand is inverted before it is replayed.
        rows = len(source["branches"]) * (1 if self.by_hand is None else 2)
        for stage, views in ((0, self.plan.chain), *enumerate(self.plan.stages)):
            rows += len(views) * len(self.view_editor.branches(stage))
        rows *= self.settings.steps
        if self.settings.latents == "inversion":
            inverted, _ = inversion_steps(self.editor, self.settings.steps)
            rows += len(self.plan.edited) * len(inverted)
        return {
            "views": 1 + len(targets),
            **({"sources": sources} if sources > 1 else {}),
            "network_rows": rows,
            "feature_bytes": sources * source["feature_bytes"],
            "injected": sum(shares) / len(shares) if shares else 0.0,
            "iterations": self.tuning.iteration,
            "splats": len(final),
        }

    def _clear_recording(self) -> None:
        recording = self.folder.path / RECORDING
        if recording.is_dir():
            shutil.rmtree(recording)

    # --- progress

    def _tell(self, text: str, steps: int = 0, *, done: int | None = None) -> None:
        self.done = self.done + steps if done is None else done
        if self.watch is not None:
            self.watch(Step(min(self.done, self.total), self.total, text))
