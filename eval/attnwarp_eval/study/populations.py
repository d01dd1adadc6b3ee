"""Scenes that a study names by a population, as files of drawn scenes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attnwarp.errors import InputError
from attnwarp_eval.drawn.population import population


def expanded(data: Mapping[str, Any]) -> dict[str, Any]:
    """A study's data with the files of its population under ``scenes``; none is drawn yet.

    Data expanded before names files, perhaps in another machine's cache: they become this one's. An
    entry of ``editing.edits`` or ``carry.edits`` for the population's name, such as ``drawn``,
    becomes one entry for each of its scenes.

    Args:
        data: data of a study; ``scenes`` is a mapping, or ``population`` names their population.

    Raises:
        InputError: there is no such population.

    Example:
        >>> study = expanded({"name": "mine", "scenes": {"drawn": 2, "seed": 7}})
        >>> [Path(name).name for name in study["scenes"]]
        ['drawn-0.yaml', 'drawn-1.yaml']
        >>> study["population"]["seed"]
        7
    """
    result = dict(data)
    scenes = result.get("scenes")
    if isinstance(scenes, Mapping):
        try:
            wanted = population(scenes)
            result["scenes"] = [str(path) for path in wanted.paths().values()]
        except InputError as error:
            raise InputError(f"scenes: {error}") from None
        result["population"] = wanted.model_dump(mode="json")
    elif result.get("population") and isinstance(scenes, list):
        wanted = population(result["population"])
        try:
            files, named = wanted.paths(), [Path(str(name)) for name in scenes]
            wanted.files({p.stem for p in named if p != files.get(p.stem) and p.is_file()})
        except InputError:
            return result  # the folder of meshes is elsewhere, and only the figures are read
        if not all(_is_one_of(path, files) for path in named):
            # With further scenes, the set is no sample of a population, whose files are drawn here.
            wanted.files({path.stem for path in named if path == files.get(path.stem)})
            result["population"] = None
            return result
        result["scenes"] = [str(files[path.stem]) for path in named]
    else:
        return result
    for key in ("editing", "carry"):
        part = result.get(key)
        edits = part.get("edits") if isinstance(part, Mapping) else None
        if isinstance(edits, Mapping) and wanted.word in edits:
            own = {name: value for name, value in edits.items() if name != wanted.word}
            each = {Path(name).stem: edits[wanted.word] for name in result["scenes"]}
            result[key] = {**result[key], "edits": {**each, **own}}
    return result


def _is_one_of(path: Path, files: Mapping[str, Path]) -> bool:
    """Return True if a file is missing, or equals the population's scene of its name."""
    own = files.get(path.stem)
    if own is None or own == path or not path.is_file():
        return own is not None
    return path.read_bytes() == own.read_bytes()
