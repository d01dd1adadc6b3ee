"""What a study's YAML says, and the cells that follow from it."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError, model_validator

from attnwarp.encoders import Kind
from attnwarp.errors import InputError, suggest
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.parts import Ablation, Fits, Front, Part, Pictures, Splats, Variant, Yaw

if TYPE_CHECKING:
    from attnwarp.fit import FitSettings
    from attnwarp_eval.scene.scene import Scene

PROTOCOLS = {"calibration": 1, "depth": 1, "warp": 1, "fit": 1, "timing": 1, "sensitivity": 1}
"""Version of each probe's protocol. Raise one when its numbers change meaning: its cells then get
new ids.
"""

ProbeName = Literal["calibration", "depth", "warp", "fit", "timing", "sensitivity"]

WITHOUT_VARIANTS = ("calibration", "sensitivity")
"""Probes that judge the instrument and not a variant: one cell a scene."""


class StudyError(InputError):
    """A study that cannot be run; the message names the file, what came and what to do."""


class Study(Part):
    """A study: scenes x variants x seeds x probes, and what the report shows of them."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    title: str = ""
    description: str = ""
    size: Annotated[int, Field(ge=16, le=4096)] = 512
    scenes: Annotated[list[str], Field(min_length=1)]
    views: list[str] = Field(
        default_factory=list, description="target views by name; all of them if empty"
    )
    seeds: Annotated[list[int], Field(min_length=1)] = Field(default_factory=lambda: [0])
    spp: Annotated[int, Field(ge=1)] = 16
    feature_sizes: list[int] = Field(
        default_factory=list, description="image size, 1/8 and 1/16 of it if left out"
    )
    feature_channels: Annotated[int, Field(ge=1, le=4096)] = 8
    timing_rounds: Annotated[int, Field(ge=3)] = 15
    splats: Splats = Splats()
    fit: Fits = Fits()
    encoders: dict[Kind, str] = Field(
        default_factory=dict, description="by kind, as load_encoder takes them"
    )
    edits: list[str] = Field(
        default_factory=list, description="edits by name; all of a scene's if empty"
    )
    variants: dict[str, Variant] = Field(default_factory=dict)
    probes: Annotated[dict[ProbeName, list[str]], Field(min_length=1)]
    ablations: list[Ablation] = Field(default_factory=list)
    yaw: Yaw = Yaw()
    fronts: list[Front] = Field(default_factory=list)
    pictures: Pictures = Pictures()

    @model_validator(mode="before")
    @classmethod
    def _feature_sizes_follow_the_image(cls, data: Any) -> Any:
        size = data.get("size", 512) if isinstance(data, dict) else None
        if isinstance(size, int) and not data.get("feature_sizes"):
            # The latent sizes of a diffusion UNet's first two levels of attention.
            return {
                **data,
                "feature_sizes": sorted(
                    {size, max(1, size // 8), max(1, size // 16)}, reverse=True
                ),
            }
        return data

    @model_validator(mode="after")
    def _names_are_known(self) -> Study:
        needed = [probe for probe in self.probes if probe not in WITHOUT_VARIANTS]
        if needed and not self.variants:
            raise ValueError(f"variants: got none, expected at least one for probes.{needed[0]}")
        if self.probes.get("sensitivity"):
            raise ValueError(
                "probes.sensitivity: got variants, expected []; it judges metrics, which no variant"
                " changes"
            )
        for name, variant in self.variants.items():
            try:
                variant.settings()
                self.splats_of(variant)
                if "fit" in self.probes or variant.fit or self.fit.settings:
                    self.fit_of(variant, 0)
            except ValidationError as error:
                raise ValueError(f"variants.{name}.splats: {explain(error, Splats)}") from None
            except ValueError as error:
                raise ValueError(f"variants.{name}: {error}") from None
        used: list[tuple[str, list[str], str | None]] = [
            (f"probes.{p}", v, None) for p, v in self.probes.items()
        ]
        used += [
            (f"ablations.{i}", [a.baseline, *a.variants], a.probe)
            for i, a in enumerate(self.ablations)
        ]
        used += [(f"fronts.{i}", f.variants, f.probe) for i, f in enumerate(self.fronts)]
        used += [
            ("pictures.variants", self.pictures.variants, None),
            ("yaw.variants", self.yaw.variants, "warp"),
        ]
        for where, names, probe in used:
            for name in names:
                if name not in self.variants:
                    raise ValueError(
                        f"{where}: no variant {name!r}{_did_you_mean(name, self.variants)}"
                    )
                # A row that is never measured would vanish from its table without a word.
                if probe is not None and name not in self.probes.get(probe, []):  # type: ignore[call-overload]
                    raise ValueError(f"{where}: {name!r} is not measured; add it to probes.{probe}")
        for name in self.probes.get("timing", []):
            if self.variants[name].geometry != "splats":
                raise ValueError(
                    f"probes.timing: {name!r} renders nothing, so there is no time to take; leave"
                    " it out"
                )
        self._metrics_are_known()
        self._encoders_are_known()
        for size in self.feature_sizes:
            if not 1 <= size <= self.size:
                raise ValueError(
                    f"feature_sizes: got {size}, expected 1 to {self.size}, the image size"
                )
        for name, values in (
            ("scenes", self.scenes),
            ("seeds", self.seeds),
            ("views", self.views),
            ("edits", self.edits),
        ):
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: something is named twice in {values}")
        return self

    def _metrics_are_known(self) -> None:
        from attnwarp_eval.metrics.registry import metric

        for i, front in enumerate(self.fronts):
            try:
                direction = metric(front.metric).direction
            except KeyError:
                raise ValueError(f"fronts.{i}.metric: no metric {front.metric!r}") from None
            if direction != "lower":
                raise ValueError(
                    f"fronts.{i}.metric: {front.metric!r} is not one of which less is better"
                )

    def _encoders_are_known(self) -> None:
        from attnwarp.encoders import kind_of

        for kind, name in self.encoders.items():
            try:
                found = kind_of(name)
            except InputError as error:
                raise ValueError(f"encoders.{kind}: {error}") from None
            if found != kind:
                raise ValueError(f"encoders.{kind}: {name!r} is of kind {found!r}")

    def splats_of(self, variant: Variant) -> Splats:
        """The study's splats with the variant's own fields."""
        return Splats.model_validate({**self.splats.model_dump(), **variant.splats})

    def fit_of(self, variant: Variant, seed: int) -> FitSettings:
        """The study's fit settings with the variant's own fields."""
        from attnwarp.fit import FitSettings

        return FitSettings.from_dict({**self.fit.settings, **variant.fit, "seed": seed})

    def cells(self, scenes: dict[str, Scene]) -> list[Cell]:
        """Every cell of the study, scene by scene; variants of the same content share one.

        Args:
            scenes: the loaded scenes by name.

        Raises:
            StudyError: a view or an edit that a scene lacks; an encoder that cannot be loaded.
        """
        found: dict[str, Cell] = {}
        identities = self._identities()
        self._edits_are_known(scenes)
        for scene_name in self.scenes:
            scene = scenes[scene_name]
            views = self._views_of(scene)
            # The instrument is judged in every run, whatever else it is used for.
            own = self._spec(scene, views, "calibration", Variant(), self.seeds[0])
            shown = tuple(v for v in self.pictures.views if v in views)
            cell = Cell(
                own,
                scene_name,
                "calibration",
                "calibration",
                self.seeds[0],
                ("calibration",),
                shown,
            )
            found[cell.id] = cell
            for probe, names in self.probes.items():
                if probe == "calibration":
                    continue
                if probe == "sensitivity":
                    for seed in self.seeds:
                        spec = self._sensitivity(scene, views, identities, seed)
                        cell = Cell(
                            spec,
                            scene_name,
                            "metrics",
                            probe,
                            seed,
                            ("metrics",),
                            encoders=self._by_kind(),
                        )
                        found[cell.id] = cell
                    continue
                if probe == "timing":
                    for seed in self.seeds:
                        cell = Cell(
                            self._timing(scene, views, names, seed),
                            scene_name,
                            "all",
                            probe,
                            seed,
                            tuple(names),
                        )
                        found[cell.id] = cell
                    continue
                for name in names:
                    for seed in self.seeds:
                        spec = self._spec(scene, views, probe, self.variants[name], seed)
                        shown = tuple(v for v in self.pictures.views if v in spec["views"])
                        pictures = shown if name in self.pictures.variants else ()
                        cell = Cell(spec, scene_name, name, probe, seed, (name,), pictures)
                        if cell.id in found:
                            old = found[cell.id]
                            cell = Cell(
                                spec,
                                scene_name,
                                old.variant,
                                probe,
                                seed,
                                (*old.labels, name),
                                old.pictures or pictures,
                            )
                        found[cell.id] = cell
        return list(found.values())

    def _timing(
        self, scene: Scene, views: list[str], names: list[str], seed: int
    ) -> dict[str, Any]:
        """One cell for all contestants: only times that were taken in turn, in one process, can be
        compared.
        """
        return {
            "probe": "timing",
            "protocol": PROTOCOLS["timing"],
            "scene": scene.content_hash,
            "size": self.size,
            "views": [views[len(views) // 2]],
            "seed": seed,
            "feature_sizes": self.feature_sizes,
            "rounds": self.timing_rounds,
            "contestants": [
                {
                    "settings": self.variants[name].settings().to_dict(),
                    "splats": self.splats_of(self.variants[name]).model_dump(),
                }
                for name in names
            ],
        }

    def _edits_are_known(self, scenes: dict[str, Scene]) -> None:
        known = list(dict.fromkeys(edit.name for scene in scenes.values() for edit in scene.edits))
        for name in self.edits:
            if name not in known:
                raise StudyError(
                    f"edits: no scene has an edit {name!r}{_did_you_mean(name, known)}"
                )

    def _by_kind(self) -> dict[str, str]:
        return {kind: self.encoders[kind] for kind in sorted(self.encoders)}

    def _identities(self) -> dict[str, dict[str, Any]]:
        """Which encoders these are, by their weights: other weights give other cells, another
        folder does not.
        """
        if "sensitivity" not in self.probes:
            return {}
        from attnwarp_eval.study.probes import sensitivity

        found = {}
        for kind, name in self.encoders.items():
            try:
                found[kind] = sensitivity.identity(name, kind)
            except InputError as error:
                raise StudyError(f"encoders.{kind}: {error}") from None
        return {str(kind): found[kind] for kind in sorted(found)}

    def _sensitivity(
        self, scene: Scene, views: list[str], encoders: dict[str, dict[str, Any]], seed: int
    ) -> dict[str, Any]:
        """One cell for all metrics of a scene: they judge the same pictures, and their times are
        taken in turn.
        """
        from attnwarp_eval.study.probes.sensitivity import tasks

        known = [edit.name for edit in scene.edits]
        if not known:
            raise StudyError(
                f"probes.sensitivity: scene {scene.name!r} names no edits, so there is no right"
                " result; leave it out, or give it some (docs/edits.md)"
            )
        asked = tasks(scene, self.edits)
        if not asked:
            raise StudyError(
                f"edits: scene {scene.name!r} has none of {', '.join(self.edits)}; there are"
                f" {', '.join(known)}"
            )
        return {
            "probe": "sensitivity",
            "protocol": PROTOCOLS["sensitivity"],
            "scene": scene.content_hash,
            "size": self.size,
            "views": views,
            "seed": seed,
            "spp": self.spp,
            "rounds": self.timing_rounds,
            "encoders": encoders,
            "tasks": [task.to_dict() for task in asked],
        }

    def _views_of(self, scene: Scene) -> list[str]:
        known = [c.name for c in scene.targets]
        for name in self.views:
            if name not in known:
                raise StudyError(
                    f"views: scene {scene.name!r} has no view {name!r}{_did_you_mean(name, known)}"
                )
        return [name for name in known if not self.views or name in self.views]

    def _spec(
        self, scene: Scene, views: list[str], probe: ProbeName, variant: Variant, seed: int
    ) -> dict[str, Any]:
        """Only what decides the probe's numbers: two variants that differ elsewhere share a
        cell."""
        settings = variant.settings().to_dict()
        spec: dict[str, Any] = {
            "probe": probe,
            "protocol": PROTOCOLS[probe],
            "scene": scene.content_hash,
            "size": self.size,
            "views": views,
            "seed": seed,
        }
        if probe == "calibration":
            return {
                **spec,
                "feature_sizes": self.feature_sizes,
                "feature_channels": self.feature_channels,
                "spp": self.spp,
            }
        if probe == "fit":
            from attnwarp_eval.splats.export import held_out_names

            how = {**self.fit.model_dump(), "settings": self.fit_of(variant, seed).to_dict()}
            depth = {name: settings[name] for name in ("depth", "depth_statistic")}
            return {
                **spec,
                "views": held_out_names(self.fit.views),
                "spp": self.spp,
                "fit": how,
                **depth,
            }
        if variant.geometry == "truth":
            spec["geometry"] = "truth"
        else:
            spec["splats"] = self.splats_of(variant).model_dump()
        if probe == "depth":
            return {
                **spec,
                "depth": settings["depth"],
                "depth_statistic": settings["depth_statistic"],
            }
        return {
            **spec,
            "spp": self.spp,
            "settings": settings,
            "feature_sizes": self.feature_sizes,
            "feature_channels": self.feature_channels,
        }


def _did_you_mean(name: str, known: Any) -> str:
    return suggest(name, list(known)) or f"; there are {', '.join(map(repr, known))}"


def shipped_studies() -> dict[str, Path]:
    """Studies that come with the package, by name."""
    folder = Path(str(resources.files("attnwarp_eval.study") / "shipped"))
    return {p.stem: p for p in sorted(folder.glob("*.yaml"))}


def load_study(name_or_path: str, **overrides: Any) -> Study:
    """Read a study by the name of a shipped one or by the path of a YAML file.

    Args:
        name_or_path: such as ``quick`` or ``my/study.yaml``.
        overrides: fields to replace, such as ``size`` or ``scenes``; None leaves a field as it is.

    Raises:
        StudyError: no such study, not YAML, an unknown key or a value out of range.
    """
    shipped = shipped_studies()
    path = shipped.get(name_or_path, Path(name_or_path))
    if not path.is_file():
        raise StudyError(
            f"{name_or_path}: no such study{_did_you_mean(name_or_path, shipped)}, or give a YAML"
            " file's path"
        )
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise StudyError(f"{path}: not YAML: {error}") from None
    if not isinstance(data, dict):
        raise StudyError(
            f"{path}: expected keys such as scenes, variants, probes; got a {type(data).__name__}"
        )
    data.update({k: v for k, v in overrides.items() if v is not None})
    try:
        return Study.model_validate(data)
    except ValidationError as error:
        raise StudyError(f"{path}: {explain(error)}") from None


class _Loader(yaml.SafeLoader):
    """Refuses a key that stands twice in one mapping, where YAML lets the last one win."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} stands twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def explain(error: ValidationError, model: type[BaseModel] = Study) -> str:
    """Pydantic's findings in one readable text: where, what was wrong, and the nearest known
    key."""
    lines = []
    for item in error.errors():
        where = ".".join(str(p) for p in item["loc"])
        message = str(item["msg"]).removeprefix("Value error, ")
        if item["type"] == "extra_forbidden":
            message = (
                f"unknown key{_did_you_mean(str(item['loc'][-1]), _known_keys(model, item['loc']))}"
            )
        lines.append(f"{where}: {message}" if where else message)
    return "; ".join(lines)


def _known_keys(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    inner: dict[str, type[BaseModel]] = {
        "splats": Splats,
        "fit": Fits,
        "variants": Variant,
        "ablations": Ablation,
        "fronts": Front,
        "pictures": Pictures,
        "yaw": Yaw,
    }
    if len(location) > 1:
        model = inner.get(str(location[0]), model)
    return list(model.model_fields)
