"""Measure how many bounces the package's scenes with ``bounces: auto``, and their edits, call for.

``python -m scripts.record_bounces`` writes ``scenes/bounces.json``, from which
:mod:`attnwarp_eval.truth.bounces` answers without measuring. Entries whose scene is what it was
stay as they are; ``--all`` measures these, too.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from attnwarp.io.file import write_atomically
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.truth import bounces
from attnwarp_eval.truth.mitsuba import forget

SCENES = Path(__file__).parents[1] / "scenes"


def worlds(folder: Path = SCENES) -> Iterator[Scene]:
    """Every scene of a folder that says ``bounces: auto``, then what edits make of them."""
    scenes = [load_scene(path) for path in sorted(folder.glob("*.yaml"))]
    scenes = [scene for scene in scenes if scene.spec.appearance.bounces == "auto"]
    yield from scenes
    for scene in scenes:
        for edit in scene.edits:
            for one in edit.answers or (None,):
                yield scene.edited(edit.name, one.name if one else None)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m scripts.record_bounces", description=__doc__)
    parser.add_argument("--all", action="store_true", help="measure every scene again")
    options = parser.parse_args(arguments)
    path = SCENES / bounces.RECORD
    former = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    entries: dict[str, Any] = {}
    for scene in worlds():
        key = bounces.key(scene)
        entry = former.get(scene.name)
        start = time.perf_counter()
        if options.all or entry is None or entry["key"] != key:
            entry = {"key": key, "answer": bounces.search(scene).to_dict()}
            forget()
            # After every scene, so that what was measured outlives an interruption.
            write(path, former | entries | {scene.name: entry})
        entries[scene.name] = entry
        words = bounces.Answer.from_dict(entry["answer"]).words
        print(f"{scene.name}, {time.perf_counter() - start:.1f} s: {words}", flush=True)
    write(path, entries)


def write(path: Path, entries: dict[str, Any]) -> None:
    """Write the record."""
    text = json.dumps(entries, indent=1) + "\n"
    write_atomically(path, lambda stream: stream.write(text.encode()))


if __name__ == "__main__":
    main()
