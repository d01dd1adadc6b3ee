"""Preview of an edit: the source's edit by several seeds, of which a person picks one.

preview/manifest.json    what the answers depend on
preview/N.png  N.json    answer of seed N, and its record
preview/N.pt             its features, which the edit goes on from; absent if they are too large
preview/index.html       page of the answers
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp.colors import ciede2000, to_lab
from attnwarp.command.page import captioned, lit, write_page
from attnwarp.editing.identity import editor_digest
from attnwarp.errors import InputError, InputWarning
from attnwarp.io.names import file_stems
from attnwarp.methods.algorithms.attention_warping import AttentionWarping
from attnwarp.methods.base import edit_file
from attnwarp.methods.change import LITTLE, say_little
from attnwarp.methods.pictures import resized, to_bytes
from attnwarp.methods.scene import digests
from attnwarp.methods.work import Work
from attnwarp.workdir import FORMAT, MANIFEST, Workdir, differences, results_in

FOLDER = "preview"

COUNT = 4
"""Number of answers."""

MOST_KEPT = 2**30
"""Largest number of bytes of one answer's features that are kept. Without them, the source is
edited once more, which takes a share of an edit's time that falls with the number of views."""


class Preview:
    """Answers of an editor to an instruction: edits of the source that differ in their seed.

    Args:
        out: folder of the edit.
        first: seed of the first answer.
        answer: seed of the answer that the edit goes on from; None to show the answers.

    Raises:
        InputError: the answer is none of the preview's.
    """

    def __init__(self, out: Path, first: int, answer: int | None = None) -> None:
        self.seeds, self.answer = range(first, first + COUNT), answer
        results = [f"{seed}.png" for seed in self.seeds]
        self.out, self.folder = out, Workdir(out / FOLDER, "a preview", results=results)
        if answer is not None and answer not in self.seeds:
            listed = ", ".join(map(str, self.seeds))
            raise InputError(f"--answer: got {answer}, expected one of the preview's: {listed}")

    def check(self, known: dict[str, Any]) -> None:
        """Refuse, before any work, a folder with an edit, or an answer that is not there.

        Args:
            known: entries of the preview's manifest.

        Raises:
            InputError: it can't be shown, or gone on from; the message says why.
        """
        if self.answer is None:
            if (self.out / MANIFEST).is_file():
                raise InputError(
                    f"{self.out}: holds an edit, which goes on from its own answer; preview others"
                    " in another folder, --out FOLDER"
                )
            return
        if not self.folder.has(MANIFEST) or not self.folder.made(f"{self.answer}.png"):
            raise InputError(
                f"--answer {self.answer}: {self.folder.path} has no such answer; run the same"
                " command with --preview in place of --answer first"
            )
        self.folder.check_claimed(known)

    def claim(self, work: Work, source: int, known: dict[str, Any]) -> None:
        """Compare what the answers depend on with the folder. Answers of something else are made
        anew, unless one of them is to go on from.

        Args:
            work: the scene and the editor, with the settings of the first answer.
            source: number of the source view.
            known: further entries of the manifest.

        Raises:
            InputError: the answer to go on from is of something else, or the folder is foreign.
        """
        about = {
            **known, "settings": work.settings.to_dict(),
            "source": work.views.cameras[source].name,
            "inputs": {
                "splats": work.frozen.digest(),
                **digests(work.views, work.segments),
                "editor": editor_digest(work.editor),
            },
        }  # fmt: skip
        if self.answer is None and self.folder.has(MANIFEST):
            stored = self.folder.read_json(MANIFEST)
            changed = differences(stored, json.loads(json.dumps({"format": FORMAT, **about})))
            if changed:
                place = self.folder.path
                work.report.log(f"{place}: made anew, as it was of other {changed[0]}")
                for seed in (int(path.stem) for path in place.glob("[0-9]*.png")):
                    for suffix in ("json", "png", "pt"):
                        (place / f"{seed}.{suffix}").unlink(missing_ok=True)
                (place / MANIFEST).unlink()
        self.folder.claim(about)

    def make(self, work: Work, source: int, known: dict[str, Any]) -> tuple[list[str], Path]:
        """Edit the source by each seed, and write the page after each; see :meth:`claim`.

        Returns:
            A line on each answer, and the path of the page.
        """
        steps, report = work.settings.steps, work.report
        lines: list[str] = []
        with results_in(self.folder.path):
            self.claim(work, source, known)
            for number, seed in enumerate(self.seeds):
                done = number * steps

                def step(seed: int = seed) -> None:
                    nonlocal done
                    done += 1
                    report.step(done, COUNT * steps, f"editing the source, answer {seed}")

                if not self.folder.made(f"{seed}.png"):
                    work.settings = work.settings.changed(seed=seed)
                    self._edit(work, source, seed, step)
                lines.append(self._line(seed))
                page = self._page(work, source, lines)
        most = max(self.folder.record(f"{seed}.png")["by"] for seed in self.seeds)
        if little := say_little({"scene": None, "source view": most}):
            warnings.warn(little, InputWarning, stacklevel=2)
        return lines, page

    def _edit(self, work: Work, source: int, seed: int, step: Callable[[], None]) -> None:
        """Edit the source by the settings' seed and keep its features."""
        settings: Any = work.settings
        method = AttentionWarping(work, settings, source, None, None, "cpu")
        (edit,) = method.edit_source(work.frozen, step)
        if method.recorded.bytes <= MOST_KEPT:
            self.folder.save(f"{seed}.pt", method.recorded.state())
        pixels, before = to_bytes(work.composite(source, edit.picture)), work.picture(source)
        inside = np.ones(pixels.shape[:2], bool)
        segment = None if work.segments is None else work.segments[source] > 0.5
        for part in (segment, work.views.masks[source]):
            if part is not None:
                mask = part[..., None].repeat(3, 2).astype(np.float32)
                inside &= resized(mask, work.sizes[source])[..., 0] > 0.5
        change = ciede2000(to_lab(to_bytes(before)[inside]), to_lab(pixels[inside]))
        about = {
            "of": "picture" if segment is None else "mask",
            "changed": float((change >= LITTLE).mean()) if change.size else 0.0,
            "by": float(change.mean()) if change.size else 0.0,
        }
        self.folder.write_record(f"{seed}.png", pixels, about)

    def _line(self, seed: int) -> str:
        about = self.folder.record(f"{seed}.png")
        return (
            f"answer {seed}: {about['changed']:.0%} of the {about['of']} changed, by"
            f" {about['by']:.1f} dE00 in the mean"
        )

    def _page(self, work: Work, source: int, lines: list[str]) -> Path:
        """Write the page of the answers so far."""
        photograph = work.views.picture(source)
        shown = [(f"{file_stems(work.views.cameras)[source]}, the source", to_bytes(photograph))]
        if work.segments is not None:
            share = np.asarray(work.segments[source], np.float32)[..., None]
            shown.append(("lit: the mark, which alone is edited", lit(photograph, share)))
        pictures = [self.folder.read_picture(f"{seed}.png") for seed in self.seeds[: len(lines)]]
        rows = [
            '<div class="row large">'
            + "".join(captioned(text, {text: pixels}) for text, pixels in row)
            + "</div>"
            for row in (shown, zip(lines, pictures, strict=True))
        ]
        said = (
            f"<p>{len(lines)} of {COUNT} answers of the editor to the same words, each from other"
            " noise. To go on from one, give the same command with <code>--answer N</code> in place"
            " of <code>--preview</code>.</p>"
        )
        title = f"<h1>{escape(work.instruction)}</h1>"
        return write_page(self.folder, work.instruction, [title, said, *rows])

    # --- going on from an answer

    def recorded(self) -> dict[str, Any] | None:
        """Load the answer with its features; None where they are not kept."""
        name = f"{self.answer}.pt"
        if not self.folder.has(name):
            return None
        return self.folder.load(name, "remove it: the source is edited once more")

    def check_source(self, name: str) -> None:
        """Refuse, with InputError, an edit of the source that is not the answer."""
        edited = Workdir(self.out, "an edit").read_picture(edit_file(0, name))
        self.folder.check_same(f"{self.answer}.png", edited)

    def drop_features(self) -> None:
        """Remove the features of all answers, once an edit has gone on from one."""
        for seed in self.seeds:
            (self.folder.path / f"{seed}.pt").unlink(missing_ok=True)
