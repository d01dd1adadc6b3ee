"""Everything that can be wrong before a run on captures starts, refused by name."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attnwarp.digest import digest
from attnwarp.editing.editor import Editor
from attnwarp.editing.schedule import DDIM, Schedule, stable_diffusion_alphas
from attnwarp.errors import InputError
from attnwarp.methods.command import mask_files
from attnwarp.reporting import SILENT, Reporter
from attnwarp_lab.captures.capture import (
    Ready,
    check_likeness,
    marks_of,
    read_splats,
    ready,
    segments,
    splats_file,
)
from attnwarp_lab.captures.manifest import Encoders, Loaded, Weights, in_folders

SCHEDULE_TOLERANCE = 1e-5
"""Largest difference of two schedules' shares of signal that is rounding."""

PROBE_TOLERANCE = 1e-3
"""Relative difference of probe values that devices and precisions cause."""

GUIDES = {"igs2gs": "picture", "dge": "picture", "fused": "picture", "gaussctrl": "depth"}
"""Kinds of editors that methods take; the others take both."""

PROBE_WORDS, PROBE_PIXELS = "a photo of a bear", 128
"""Words of a probe value, and least sides of its view."""


@dataclass
class Checked:
    """A manifest's inputs.

    Attributes:
        problems: lines, each of which forbids a run.
        weights: by their key, SHA-256 and probe value.
        captures: content's SHA-256 by the capture's name.
        splats: SHA-256 by the capture's name and the kind; fitted ones are left out.
        masks: SHA-256 of masks by the capture's name.
        views: names of the views by the capture's name.
        sizes: longest side in px at which each editor works.
    """

    problems: list[str] = field(default_factory=list)
    weights: dict[str, tuple[str, float]] = field(default_factory=dict)
    captures: dict[str, str] = field(default_factory=dict)
    splats: dict[str, dict[str, str]] = field(default_factory=dict)
    masks: dict[str, str] = field(default_factory=dict)
    views: dict[str, list[str]] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)

    @contextmanager
    def asking(self, place: str = "") -> Iterator[None]:
        """Note what is wrong in a block as one problem."""
        try:
            yield
        except (InputError, FileNotFoundError, ValueError) as error:
            text = str(error)
            self.problems.append(text if text.startswith(place) else f"{place}: {text}")

    def refuse(self) -> None:
        """Raise InputError with all problems, if there are any."""
        if self.problems:
            raise InputError("\n".join(self.problems))


def check(loaded: Loaded, run: Path, device: str, report: Reporter = SILENT) -> Checked:
    """Check captures, splats, masks, weights, and whether methods and editors fit.

    Args:
        loaded: the manifest.
        run: the run's folder, which keeps masks by words.
        device: device of the networks while they are probed.
        report: hears what masks mark.
    """
    done = Checked()
    for name in loaded.manifest.captures:
        with done.asking(f"captures.{name}"):
            _check_capture(loaded, name, run, device, done, report)
    for name in loaded.manifest.editors:
        with done.asking(f"editors.{name}"):
            _check_editor(loaded, name, device, done)
    for kind in Encoders.model_fields:
        with done.asking(f"encoders.{kind}"):
            _check_encoder(loaded, kind, device, done)
    return done


def _check_capture(
    loaded: Loaded, name: str, run: Path, device: str, done: Checked, report: Reporter
) -> None:
    capture = ready(loaded, name)
    same = [other for other, content in done.captures.items() if content == capture.content]
    if same:
        raise InputError(
            f"captures.{name}: has the pictures and cameras of {same[0]!r}; name a capture once"
        )
    done.captures[name] = capture.content
    done.views[name] = [camera.name for camera in capture.cameras]
    done.splats[name] = {}
    for kind in loaded.manifest.captures[name].splats:
        place, path = f"captures.{name}.splats.{kind}", splats_file(loaded, run, name, kind)
        with done.asking(place):
            splats = read_splats(path, kind)
            done.splats[name][kind] = splats.digest()
            check_likeness(place, path, capture, splats)
    part = loaded.manifest.captures[name].mask
    if part is None:
        return
    with done.asking(f"captures.{name}.mask"):
        segments(loaded, name, run, device, report)
        marks = marks_of(loaded, name)
        files = [marks.mask] if marks.mask else []
        files += mask_files(marks.masks, capture.cameras) if marks.masks else []
        done.masks[name] = digest(part.model_dump(mode="json"), *(p.read_bytes() for p in files))


def _check_editor(loaded: Loaded, name: str, device: str, done: Checked) -> None:
    from attnwarp.editing.small import check_words, load_editor
    from attnwarp.methods import preset
    from attnwarp.methods.view_edits import check_editor
    from attnwarp_eval.study.shared.edits import files_digest

    weights, place = loaded.manifest.editors[name], f"editors.{name}"
    editor: Editor = load_editor(loaded.editor(name), device=device)
    tensors = {
        f"{part}.{key}": value
        for part, network in editor.parts.items()
        if isinstance(network, torch.nn.Module)
        for key, value in network.state_dict().items()
    }
    _check_shapes(place, weights, tensors)
    if weights.scheduler == "stable-diffusion" and place in in_folders(loaded.manifest):
        _check_scheduler(place, editor.schedule)
    _note(done, place, weights, files_digest(loaded.editor(name)), _probe_editor(editor))
    for capture, edit in loaded.edits():
        text = loaded.manifest.captures[capture].edits[edit].text(editor.guide)
        with done.asking(f"captures.{capture}.edits.{edit}"):
            editor.check_text(text)
            check_words(weights.folder, text, anyway=True)
    done.sizes[name] = loaded.manifest.size or editor.own_size
    for row_name, row in loaded.manifest.variants.items():
        if row.editor != name:
            continue
        with done.asking(f"variants.{row_name}"):
            wanted = GUIDES.get(row.method, editor.guide)
            if wanted != editor.guide:
                raise InputError(
                    f"variants.{row_name}: {row.method} takes an editor guided by a {wanted}, and"
                    f" {name!r} is guided by a {editor.guide}; name another editor"
                )
            if row.method == "attention_warping":
                own = {"steps": editor.own_steps, **row.options}
                check_editor(editor, preset(row.method, row.preset, **own))
    del editor, tensors
    gc.collect()


def _check_shapes(place: str, weights: Weights, tensors: Mapping[str, Any]) -> None:
    for key, expected in weights.shapes.items():
        if key not in tensors:
            raise InputError(
                f"{place}: {weights.folder} has no tensor {key}, expected one of shape"
                f" {expected}: it is another model; fetch the one that the manifest names"
            )
        got = list(tensors[key].shape)
        if got != expected:
            raise InputError(
                f"{place}: {weights.folder}: {key} has shape {got}, expected {expected}: it is"
                " another model; fetch the one that the manifest names"
            )


def _check_scheduler(place: str, schedule: Schedule) -> None:
    if not isinstance(schedule, DDIM):
        raise InputError(
            f"{place}: its schedule is not Stable Diffusion's; write `scheduler: any`, which asks"
            " for none"
        )
    expected = stable_diffusion_alphas()
    own = schedule.alphas.double().cpu()
    if schedule.prediction != "epsilon":
        raise InputError(
            f"{place}: its scheduler says prediction_type {schedule.prediction!r}, expected"
            " 'epsilon'; fetch scheduler/scheduler_config.json of the published model"
        )
    if own.shape != expected.shape or float((own - expected).abs().max()) > SCHEDULE_TOLERANCE:
        raise InputError(
            f"{place}: its scheduler leaves {float(own[-1]):.4f} of the signal after {len(own)}"
            f" steps, expected {float(expected[-1]):.4f} after {len(expected)}; fetch"
            " scheduler/scheduler_config.json of the published model"
        )


def _check_encoder(loaded: Loaded, kind: Any, device: str, done: Checked) -> None:
    from attnwarp.encoders import load_encoder

    name, place = loaded.encoder(kind), f"encoders.{kind}"
    encoder: Any = load_encoder(name, kind, device=device)
    weights = getattr(loaded.manifest.encoders, kind)
    if weights.shapes:
        model = getattr(encoder, "_model", None)
        _check_shapes(place, weights, {} if model is None else model.state_dict())
    _note(done, place, weights, encoder.about.weights_sha256, _probe_encoder(encoder, kind))


def _note(done: Checked, place: str, weights: Weights, sha256: str, probe: float) -> None:
    """Note the hash and the probe value of weights, and refuse those that the manifest lacks."""
    done.weights[place] = sha256, probe
    if weights.sha256 is not None and weights.sha256 != sha256:
        raise InputError(
            f"{place}.sha256: the files of {weights.folder} have {sha256}, expected"
            f" {weights.sha256}; fetch them again, or take the key out to trust the probe value"
        )
    wanted = weights.probe
    if wanted is not None and abs(probe - wanted) > PROBE_TOLERANCE * max(abs(wanted), 1e-6):
        raise InputError(
            f"{place}.probe: {weights.folder} gives {probe:.6g}, expected {wanted:.6g}: it has the"
            " right shapes and other weights; fetch the checkpoint that the manifest names"
        )


def pattern(*shape: int) -> torch.Tensor:
    """Values cos(0.37 k), k counted along the last axis first: the input of probe values.

    Example:
        >>> pattern(1, 2).numpy().round(3).tolist()
        [[1.0, 0.932]]
    """
    return torch.cos(0.37 * torch.arange(int(np.prod(shape)), dtype=torch.float64)).reshape(shape)


def _rms(values: torch.Tensor) -> float:
    return float(values.double().square().mean().sqrt())


@torch.no_grad()
def _probe_editor(editor: Editor) -> float:
    """Root mean square of a prediction for fixed noise and view, plus that of the latents."""
    side = editor.side_multiple * math.ceil(PROBE_PIXELS / editor.side_multiple)
    picture = (0.5 + 0.5 * pattern(side, side, 3)).float().numpy()
    task = editor.task([picture if editor.guide == "picture" else 1 + picture[..., 0]], PROBE_WORDS)
    latents = editor.encode([picture])
    step = editor.schedule.timesteps(2, task.shape[2:])[1]
    return _rms(task.predict(pattern(*task.shape).to(latents), step)) + _rms(latents)


def _probe_encoder(encoder: Any, kind: str) -> float:
    """Share of fixed embeddings along :func:`pattern`; of a distance, its value."""
    picture = (0.5 + 0.5 * pattern(64, 64, 3)).float().numpy()
    if kind == "perceptual":
        return float(encoder.distance([picture], [picture[::-1].copy()])[0])
    rows = [encoder.images([picture])[0]]
    if kind == "clip":
        rows.append(encoder.texts([PROBE_WORDS])[0])
    return sum(float(row @ pattern(len(row)).numpy() / np.linalg.norm(row)) for row in rows)


__all__ = ["Checked", "Ready", "check", "pattern"]
