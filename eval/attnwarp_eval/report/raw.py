"""Raw results of a run in one compressed file, from which every figure of its report can be
computed
again: ``results.jsonl.xz``, the study and then one line for each cell.
"""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from attnwarp.errors import InputError
from attnwarp_eval.canonical_json import canonical_json
from attnwarp_eval.files import write_atomic
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Outcome, Results
from attnwarp_eval.study.schema import Study
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.study import parse_study

FORMAT = 1
"""Version of the file's layout; readers refuse other versions."""

NAME = "results.jsonl.xz"

PARTS = "results*.jsonl.xz"
"""Files of raw results in a folder; several are parts of one study."""

GONE = {
    "growing": "attention_warping", "seeded": "attention_warping",
    "growing true pictures": "true pictures", "seeded true pictures": "true pictures",
}  # fmt: skip
"""Methods of committed results that no study has any more, and those that they varied."""

FILTERS = [
    {
        "id": lzma.FILTER_LZMA2,
        "preset": 9 | lzma.PRESET_EXTREME,
        "nice_len": 273,
        "lc": 4,
        "pb": 0,
    }
]
"""Filters of compression, by which text takes up to 15 % less than by a preset alone."""

DIGITS = 6
"""Significant digits of a figure: the rounding is below every tolerance of a metric."""


def write_raw(store: Store, path: Path) -> Path:
    """Write the raw results of a run, without its pictures and without paths of this machine.
    Return the file's path.

    Args:
        path: path of the file; in a folder, the file is called :data:`NAME`.

    Raises:
        StoreError: the folder is not a run, or a record is damaged.
    """
    if path.is_dir() or not path.suffix:
        path = path / NAME
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "".join(f"{line}\n" for line in _lines(store))
    write_atomic(path, lzma.compress(text.encode(), filters=FILTERS))
    return path


def _lines(store: Store) -> Iterator[str]:
    stored, done = store.read_study(), store.done()
    study = dict(stored["study"])
    if study.get("population"):
        study["scenes"] = [Path(name).name for name in study["scenes"]]
        if "meshes" in study["population"]:  # the folder is specific to this machine
            name = Path(study["population"]["meshes"]).name
            study["population"] = {**study["population"], "meshes": name}
    notices = {name: entry.get("notices", []) for name, entry in stored["scenes"].items()}
    # Not sorted: tables follow the order in which a study names its variants.
    yield json.dumps({"raw": FORMAT, "study": study, "notices": notices}, separators=(",", ":"))
    for cell in stored["cells"]:
        record: dict[str, Any] | None = None
        if cell["id"] in done:
            record = _shortened(store.read(cell["id"]))
            record |= {"pictures": []}
            for name in ("format", "sha256"):
                del record[name]
        yield canonical_json({"cell": cell, "record": record})


def _shortened(value: Any) -> Any:
    if isinstance(value, float) and math.isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {key: _shortened(item) for key, item in value.items()}
    return [_shortened(item) for item in value] if isinstance(value, list) else value


def read_raw(path: Path) -> Results:
    """Read the results in a file of raw results.

    Raises:
        InputError: the file is damaged, of another version, or its study cannot be read.
    """
    remedy = "take it from version control again, or write it with attnwarp-eval report RUN --raw"
    try:
        head, *cells = map(json.loads, lzma.decompress(path.read_bytes()).decode().splitlines())
        if head["raw"] != FORMAT:
            raise InputError(f"{path}: {head['raw']!r} is another version's; {remedy}")
        study = _study(head["study"])
        outcomes = [_outcome(**line) for line in cells]
    except (lzma.LZMAError, ValueError, LookupError, TypeError, AttributeError) as error:
        why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise InputError(f"{path}: no raw results ({why}); {remedy}") from None
    return Results(study, outcomes, [], {k: v for k, v in head["notices"].items() if v})


def _study(data: Any) -> Study:
    """Parse the study of raw results, with old keys and values translated to this version."""
    if data.get("population"):
        data["population"].pop("stratify", None)  # empty in committed results
    for variant in data.get("variants", {}).values():
        if variant.get("options", {}).get("method") == "each view alone":
            # Committed results have it, for edits bit-identical to those with a0: 0.
            del variant["options"]["method"]
            variant["options"]["a0"] = 0.0
        if variant.get("control") == "another seed":
            # No key says it any more. A drift by 0 keeps it apart from the variant it repeats.
            variant |= {"control": None, "drift": {}}
        if variant.get("method") in GONE:
            variant |= {"method": GONE[variant["method"]], "drift": {}}
        # Committed results have arms of several sources, which no edit has any more.
        variant.get("options", {}).pop("sources", None)
    try:
        return parse_study(data)
    except ValidationError as error:
        lacking = [one["loc"] for one in error.errors() if one["type"] == "extra_forbidden"]
        if not lacking:
            raise
    for *above, key in lacking:
        part = data
        for step in above:
            part = part[step]
        del part[key]
    return parse_study(data)


def _outcome(cell: dict[str, Any], record: dict[str, Any] | None) -> Outcome:
    if record is None:
        return Outcome.of(cell, None)
    return Outcome.of(cell, probe(cell["probe"]).read({**record, "pictures": []}))


def read_parts(folder: Path) -> Results:
    """Read a folder's files of raw results as one run.

    Raises:
        InputError: as for :func:`read_raw` and :func:`together`.
    """
    return together([read_raw(path) for path in sorted(folder.glob(PARTS))])


def together(parts: Sequence[Results]) -> Results:
    """Merge parts of one study, each run on some of its scenes, into one run.

    Raises:
        InputError: the parts' studies differ in more than their scenes.
    """
    whole = max((part.study for part in parts), key=_count)
    keys = [_but_scenes(part) for part in parts]
    for part, key in zip(parts, keys, strict=True):
        different = [name for name, value in keys[0].items() if key.get(name) != value]
        if different:
            raise InputError(
                f"study {part.study.name}: parts differ in {', '.join(different)}, so they are no"
                " parts of one study; keep one of them"
            )
    scenes = dict(
        pair
        for part in parts
        for pair in zip(part.study.scene_names, part.study.scenes, strict=True)
    )
    if whole.population is not None:
        scenes = {name: scenes[name] for name in whole.population.names if name in scenes}
    cells = {cell.id: cell for part in parts for cell in part.cells}
    cells |= {c.id: c for part in parts for c in part.cells if c.record is not None}
    study = whole.model_copy(update={"scenes": list(scenes.values())})
    notices = {name: lines for part in parts for name, lines in part.notices.items()}
    return replace(parts[0], study=study, cells=list(cells.values()), notices=notices)


def _count(study: Study) -> int:
    return 0 if study.population is None else study.population.count


def _but_scenes(part: Results) -> dict[str, Any]:
    """All that decides the cells of a study, without its scenes."""
    data = part.study.model_dump(mode="json")
    for name in ("scenes", "title", "description"):
        data.pop(name)
    if part.study.population is not None:
        data["population"] = part.study.population.sized(1).model_dump(mode="json")
    if isinstance(data.get("editing"), dict):
        data["editing"] = {**data["editing"], "edits": None}
    return data
