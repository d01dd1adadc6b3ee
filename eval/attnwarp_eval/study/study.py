"""Conversion of a study's YAML to its cells: the shared parts joined with every probe's."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, ValidationError, create_model, model_validator

from attnwarp.errors import InputError
from attnwarp.io.text import read_text
from attnwarp_eval.metrics.registry import Metric
from attnwarp_eval.plugins import plugin_folders
from attnwarp_eval.scene import explain
from attnwarp_eval.scene.file import is_scene_file, scene_name
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.yaml import Place, YamlError, line_of, read_yaml
from attnwarp_eval.study.cell import Cell, merged
from attnwarp_eval.study.populations import expanded
from attnwarp_eval.study.probe import Probe, probe, probes
from attnwarp_eval.study.schema import (
    FIGURE,
    Splats,
    Study,
    StudyError,
    Variant,
    check_distinct,
    did_you_mean,
)

KEYS = "study/shipped/quick.yaml"
"""Bundled file that shows the keys of a study, for messages."""


_Lines = dict[Place, tuple[Path, int]]
"""File and line (from 1) of every key path of a study."""


class _Joined(Study):
    """A study whose names are checked against the probes."""

    @model_validator(mode="before")
    @classmethod
    def _scenes_of_a_population(cls, data: Any) -> Any:
        return expanded(data) if isinstance(data, dict) else data

    @model_validator(mode="after")
    def _check_against_the_probes(self) -> _Joined:
        available = {p.name: p for p in probes()}
        for name in self.probes:
            if name not in available:
                raise ValueError(f"probes: no probe {name!r}{did_you_mean(name, available)}")
        judged_on = [name for name in self.probes if available[name].needs_scenes]
        if judged_on and not self.scenes:
            raise ValueError(f"scenes: got none, expected at least 1 for probes.{judged_on[0]}")
        judging = [name for name in self.probes if available[name].judges_variants]
        if judging and not self.variants:
            raise ValueError(f"variants: got none, expected at least one for probes.{judging[0]}")
        self._check_each_variant()
        for name, variants in self.probes.items():
            if not variants and available[name].judges_variants:
                raise ValueError(f"probes.{name}: names no variant, expected at least one")
            self.check_variants(variants, f"probes.{name}")
            check_distinct(variants, f"probes.{name}")
        for i, ablation in enumerate(self.ablations):
            names = [ablation.baseline, *ablation.variants]
            self._check_table(ablation.probe, names, f"ablations[{i}]")
            check_distinct(ablation.variants, f"ablations[{i}].variants")
        for i, front in enumerate(self.fronts):
            self._check_table(front.probe, front.variants, f"fronts[{i}]")
            check_distinct(front.variants, f"fronts[{i}].variants")
            key = f"fronts[{i}].metric"
            if _known_metric(front.metric, available[front.probe], key).direction != "lower":
                raise ValueError(f"{key}: {front.metric!r} is not one of which less is better")
        self._check_answer(available)
        self.check_variants(self.pictures.variants, "pictures.variants")
        measured = set[str]().union(*(p.measured(self) for p in available.values()))
        for name in self.pictures.variants:
            if name not in measured:
                raise ValueError(f"pictures.variants: no probe measures {name!r}; leave it out")
        for p in available.values():
            p.check(self)
        return self

    def _check_table(self, name: str, variants: Sequence[str], key: str) -> None:
        """Raise ValueError unless the probe of a table is written and measures its variants."""
        tabled = [p.name for p in probes() if p.tabled]
        if not name:
            measuring = [own for own in self.probes if own in tabled]
            lines = " or ".join(f"'probe: {own}'" for own in measuring or tabled)
            raise ValueError(f"{key}.probe: is missing; write {lines}")
        if name not in tabled:
            near = did_you_mean(name, tabled)
            raise ValueError(f"{key}.probe: no table can be made of {name!r}{near}")
        self.check_variants(variants, key, name)

    def _check_answer(self, available: dict[str, Probe[Any]]) -> None:
        if self.answer is None:
            return
        asked = self.answer
        for key, columns in (("columns", asked.columns), ("figures", asked.figures)):
            for title, column in columns.items():
                rows = list(asked.variants) if key == "columns" else []
                rows += [column.control, column.alone] if column.control else []
                self._check_table(column.probe, rows, f"answer.{key}.{title}")
                _known_metric(
                    column.metric, available[column.probe], f"answer.{key}.{title}.metric"
                )
        for i, entry in enumerate(asked.pictures):
            self._check_table(entry.probe, entry.variants, f"answer.pictures[{i}]")
        if self.answer.decides not in self.answer.columns:
            near = did_you_mean(self.answer.decides, self.answer.columns)
            raise ValueError(f"answer.decides: no column {self.answer.decides!r}{near}")
        for sentence in self.answer.sentences:
            for title, variant in FIGURE.findall(sentence):
                columns = {**asked.figures, **asked.columns}
                place = f"answer.sentences: {{{title}|{variant}}}"
                if title not in columns:
                    raise ValueError(f"{place} names {title!r}{did_you_mean(title, columns)}")
                self.check_variants([variant], place, columns[title].probe)

    def _check_each_variant(self) -> None:
        for name, variant in self.variants.items():
            # Timing applies to whatever else is measured of a variant.
            measuring = [p for p in probes() if name in p.measured(self) and not p.times_in_turn]
            try:
                if not measuring or not all(p.edits for p in measuring):
                    variant.settings()
                self.splats_of(variant)
                for p in probes():
                    p.check_variant(self, variant)
            except ValidationError as error:
                why = explain_errors(error, Splats)
                raise ValueError(f"variants.{name}.splats: {why}") from None
            except ValueError as error:
                raise ValueError(f"variants.{name}: {error}") from None


def _known_metric(metric: str, own: Probe[Any], key: str) -> Metric:
    try:
        known = own.metric(metric)
    except KeyError:
        near = did_you_mean(metric, own.metrics)
        raise ValueError(f"{key}: no metric {metric!r}{near}") from None
    if "{" in metric.replace("{layer}", ""):
        raise ValueError(f"{key}: got {metric!r}; braces may hold 'layer' alone")
    return known


def parse_study(data: Any) -> Study:
    """Parse a study from plain data, with the parts of every probe.

    Raises:
        ValidationError: an unknown key or a value out of range.

    Example:
        >>> variants = {"corrected": {}, "slipped": {"set": {"pixel_centers": "integer"}}}
        >>> content = dict(name="my", scenes=["spheres"], variants=variants)
        >>> study = parse_study(content | {"probes": {"warp": ["slipped"]}})
        >>> study.variants["slipped"].settings().pixel_centers
        'integer'
    """
    return _models(tuple(probes()))[0].model_validate(data)


def parse_variant(data: Any) -> Variant:
    """Parse a variant from plain data, with the parts of every probe.

    Raises:
        ValidationError: an unknown key or a value out of range.
    """
    return _models(tuple(probes()))[1].model_validate(data)


@cache
def _models(joined: tuple[Probe[Any], ...]) -> tuple[type[Study], type[Variant]]:
    """The models of a study and of a variant, with the parts of ``joined``."""
    variant_parts = [p.variant_part for p in joined if p.variant_part is not None]
    study_parts = [p.study_part for p in joined if p.study_part is not None]
    variant: Any = create_model("Variant", __base__=(Variant, *variant_parts))
    fields: dict[str, Any] = {"variants": (dict[str, variant], Field(default_factory=dict))}
    study: Any = create_model("Study", __base__=(_Joined, *study_parts), **fields)
    return study, variant


def cells_of(study: Study, scenes: dict[str, Scene]) -> list[Cell]:
    """Every cell of a study, scene by scene; variants of the same content share one.

    Raises:
        StudyError: the study does not fit a scene, such as a view that the scene lacks.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> variants = {"a": {}, "b": {"preset": "corrected"}}  # of the same content
        >>> content = dict(name="my", scenes=["spheres"], variants=variants)
        >>> study = parse_study(content | {"probes": {"warp": ["a", "b"]}})
        >>> cells = cells_of(study, {"spheres": load_scene("spheres")})
        >>> [cell.labels for cell in cells if cell.probe == "warp"]
        [('a', 'b')]
    """
    where = dict(zip(study.scene_names, study.scenes, strict=True))
    ordered = {name: scenes[path] for name, path in where.items()}
    names: dict[str, list[str]] = {p.name: [] for p in probes() if p.always}
    names |= {name: variants for name, variants in study.probes.items()}
    cells = [
        cell
        for name, variants in names.items()
        for cell in probe(name).cells(study, variants, ordered)
    ]
    cells = [
        replace(cell, sources={**cell.sources, "scene": where[cell.scene]})
        if is_scene_file(where.get(cell.scene))
        else cell
        for cell in cells
    ]
    place = {name: i for i, name in enumerate(ordered)}
    # Cells without a scene come last, in their order.
    return merged(sorted(cells, key=lambda cell: place.get(cell.scene, len(place))))


def shipped_studies() -> dict[str, Path]:
    """Studies that come with the package or in a plugin's folder ``studies``, by name."""
    own = Path(str(resources.files("attnwarp_eval.study") / "shipped"))
    files = [p for folder in (own, *plugin_folders("studies")) for p in folder.glob("*.yaml")]
    return {p.stem: p for p in sorted(files, key=lambda p: p.stem)}


def scene_files(study: Study) -> list[str]:
    """Names or files of a study's scenes, after those that are missing are drawn.

    Raises:
        InputError: a scene of the population cannot be drawn.
    """
    if study.population is not None:
        study.population.files(study.scene_names)
    return study.scenes


def load_study(name_or_path: str, **overrides: Any) -> Study:
    """Read a study by the name of a shipped one or by the path of a YAML file.

    Relative paths in the file start at the file's folder; those of ``overrides`` at the current
    folder.

    Args:
        name_or_path: name or path, such as ``quick`` or ``my/study.yaml``.
        overrides: fields to replace, such as ``size`` or ``scenes``; None leaves a field as it is.

    Raises:
        StudyError: no such study, invalid YAML, an unknown key, a value out of range, a variant
            that no probe measures, or studies that extend each other in a circle.

    Example:
        >>> study = load_study("quick", scenes=["spheres"])
        >>> study.name, study.scenes
        ('quick', ['spheres'])
    """
    shipped = shipped_studies()
    path = shipped.get(name_or_path, Path(name_or_path))
    if not path.is_file():
        raise StudyError(
            f"{name_or_path}: no such study{did_you_mean(name_or_path, shipped)}, or give a YAML"
            " file's path"
        )
    data, lines = _read(path)
    try:
        data = expanded(data)
    except InputError as error:
        where, at_line = line_of(lines, ("scenes",))
        raise StudyError(f"{where}:{at_line}: {error}") from None
    every = data.get("scenes")
    named = every if isinstance(every, list) else ()
    files = {scene_name(where): where for where in named if is_scene_file(where)}
    data.update({k: v for k, v in overrides.items() if v is not None})
    if overrides.get("scenes") is not None:
        # Reports call a scene of the file by its name.
        data["scenes"] = [files.get(name, name) for name in data["scenes"]]
    if isinstance(data.get("scenes"), list):
        # Absolute paths: the run is reported and inspected from other folders.
        data["scenes"] = [
            str(Path(name).expanduser().absolute()) if is_scene_file(name) else name
            for name in data["scenes"]
        ]
    try:
        study = parse_study(data)
    except ValidationError as error:
        told = explain_errors(error)
        place = _place(told, lines)
        file, line = lines[place] if place else (path, None)
        at = f"{file}:{line}" if line else str(file)
        if file != path:
            told += f"; {path.name} may have {place[0]} of its own, or '{place[0]}: null'"
        elif ("extends",) in lines and error.errors()[0].get("input", 0) is None:
            told += "; null takes a key of the extended study away, which has none of this name"
        raise StudyError(f"{at}: {told}") from None
    measured = set[str]().union(*(p.measured(study) for p in probes()))
    for name in study.variants:
        file, line = line_of(lines, ("variants", name))
        if name not in measured and file == path:
            raise StudyError(
                f"{file}:{line}: variants.{name}: no probe measures it; name it under probes, or"
                " leave it out"
            )
    kept = {name: own for name, own in study.variants.items() if name in measured}
    study = study.model_copy(update={"variants": kept})
    if isinstance(every, list):
        called = {scene_name(name) for name in study.scenes}
        study._left_out = tuple(name for name in every if scene_name(name) not in called)
    return study


def _read(path: Path, above: tuple[Path, ...] = ()) -> tuple[dict[str, Any], _Lines]:
    """A study's data joined with its extended studies', and file and line of each key path.

    Args:
        above: files that extend this one, outermost first.
    """
    try:
        read, data = read_yaml(read_text(path))
    except (YamlError, UnicodeDecodeError) as error:
        line = f":{error.line}" if isinstance(error, YamlError) and error.line else ""
        raise StudyError(f"{path}{line}: {error}") from None
    if not isinstance(data, dict):
        raise StudyError(
            f"{path}: expected keys such as scenes, variants, probes; got a {type(data).__name__}"
        )
    if {"objects", "cameras"} <= data.keys():
        raise StudyError(
            f"{path}: is a scene; name it under 'scenes' in a study, or as run STUDY --scenes"
            f" {path}"
        )
    lines = {place: (path, line) for place, line in read.items()}
    data = _beside(data, path.parent)
    if "extends" not in data:
        return data, lines
    name, at = data.pop("extends"), f"{path}:{read['extends',]}: extends"
    if not isinstance(name, str):
        raise StudyError(f"{at}: got {name!r}, expected the name of a study or a YAML file's path")
    shipped = shipped_studies()
    base = shipped.get(name, path.parent / Path(name).expanduser())
    if not base.is_file():
        raise StudyError(
            f"{at}: no such study {name!r}{did_you_mean(name, shipped)}, or give a YAML file's path"
            " from the folder of this file"
        )
    chain = (*above, path)
    if base.resolve() in {file.resolve() for file in chain}:
        way = " extends ".join(file.name for file in (*chain, base))
        raise StudyError(f"{at}: leads back to {base.name} ({way}); leave one out")
    return _extended(*_read(base, chain), data, lines)


def _extended(
    base: dict[str, Any], base_lines: _Lines, own: dict[str, Any], own_lines: _Lines
) -> tuple[dict[str, Any], _Lines]:
    """Merge a study's data over the data of the study that it extends.

    Mappings are merged, all else is replaced; null removes an inherited key. Scenes of meshes
    replace drawn ones, and the reverse, since they have different keys.
    """
    replaced: list[Place] = []

    def over(old: Any, new: Any, place: Place) -> Any:
        both = isinstance(old, dict) and isinstance(new, dict)
        other_kind = both and place == ("scenes",) and "meshes" in old.keys() ^ new.keys()
        if not both or (other_kind and new.keys() & {"meshes", "drawn"}):
            replaced.append(place)
            return new
        joined = old | {
            key: over(old[key], value, (*place, key)) if key in old else value
            for key, value in new.items()
        }
        return {
            key: value
            for key, value in joined.items()
            if not (value is None and key in new and key in old)
        }

    data = over(base, own, ())
    kept = {
        place: at
        for place, at in base_lines.items()
        if not any(place[: len(root)] == root for root in replaced)
    }
    return data, kept | own_lines


def _place(told: str, lines: _Lines) -> Place:
    """The deepest key path of a study's files with which an error begins; empty without one."""
    paths = {"".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in p)[1:]: p for p in lines}
    named = [text for text in paths if re.match(rf"{re.escape(text)}[.:[]", told)]
    return paths[max(named, key=len)] if named else ()


def _beside(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Resolve the relative paths in a study's data from the folder of its file.

    Paths are scenes such as ``my/scene.yaml`` and encoders such as ``clip:my/folder``. Values of
    another type stay as they are, for a later error message.
    """

    def beside(text: Any) -> Any:
        if not isinstance(text, str) or text.startswith("~"):
            return text
        return str(folder / text)

    data = dict(data)
    scenes, encoders = data.get("scenes"), data.get("encoders")
    if isinstance(scenes, list):
        data["scenes"] = [beside(name) if is_scene_file(name) else name for name in scenes]
    elif isinstance(scenes, dict) and "meshes" in scenes:
        meshes = beside(scenes["meshes"])
        data["scenes"] = {**scenes, "meshes": str(Path(meshes).expanduser().absolute())}
    if isinstance(encoders, dict):
        data["encoders"] = {
            kind: f"{name.partition(':')[0]}:{beside(name.partition(':')[2])}"
            if isinstance(name, str) and name.partition(":")[2]
            else name
            for kind, name in encoders.items()
        }
    return data


def explain_errors(error: ValidationError, model: type[BaseModel] | None = None) -> str:
    """Pydantic's errors in one readable text: each key, the given value, and the expected value."""
    model = model or _models(tuple(probes()))[0]
    problems = error.errors(include_url=False)
    return "; ".join(explain.explain(problem, model, KEYS) for problem in problems)
