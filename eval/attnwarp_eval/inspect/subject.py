"""What there is to inspect: the variants and views of a run, or of a scene under the presets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from attnwarp.errors import InputError, suggest
from attnwarp.warp import PRESETS
from attnwarp_eval.inspect.pair import Pair
from attnwarp_eval.study.parts import Splats, Variant
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.study import parse_study
from attnwarp_eval.world import splats, world

SIZE = 512
"""Image size of a scene that is inspected by its name."""


@dataclass(frozen=True)
class Subject:
    """A scene with the variants and the target views that can be inspected.

    Attributes:
        scene: name or path.
        size: of the images, in pixels.
        spp: samples a pixel of the true pictures.
        seed: of the splats.
        variants: by name, each with its splats; None stands for the truth's own depth.
        targets: names of the views.

    Example:
        >>> subject = of_scene("spheres", 16)
        >>> subject.pair("corrected", "yaw030").target
        'yaw030'
    """

    scene: str
    size: int
    spp: int
    seed: int
    variants: dict[str, tuple[Variant, Splats | None]]
    targets: tuple[str, ...]

    def pair(self, variant: str, target: str) -> Pair:
        """One target view under one variant.

        Raises:
            InputError: there is no such variant or view.
        """
        one_of(variant, list(self.variants), "variant")
        one_of(target, list(self.targets), "view")
        chosen, model = self.variants[variant]
        gaussians = None
        if model is not None:
            gaussians = splats(self.scene, self.size, self.seed, **model.model_dump())
        return Pair(world(self.scene, self.size), target, chosen.settings(), gaussians, self.spp)


def of_scene(scene: str, size: int = SIZE) -> Subject:
    """A scene under the three presets, with splats as studies put them on its surfaces.

    Raises:
        InputError: there is no such scene.

    Example:
        >>> sorted(of_scene("spheres", 16).variants)
        ['corrected', 'paper', 'released']
    """
    model = Splats(position_noise=0.1, normal_noise=3.0)
    variants: dict[str, tuple[Variant, Splats | None]] = {
        name: (Variant(preset=name), model) for name in sorted(PRESETS)
    }
    targets = tuple(world(scene, size).targets)
    return Subject(scene, size, 8, 0, variants, targets)


def of_run(folder: Path, scene: str | None = None, size: int | None = None) -> Subject:
    """A run's variants and views.

    Args:
        folder: of the run.
        scene: one of the run's; the first, if left out.
        size: of the images; the run's own, if left out.

    Raises:
        InputError: the folder is no run, or the run has no such scene or no warps.

    Example:
        >>> from attnwarp_eval.study import Store, parse_study
        >>> from attnwarp_eval.study.run import expected, plan
        >>> content = dict(name="my", scenes=["spheres"], size=16, variants={"a": {}})
        >>> study = parse_study(content | {"probes": {"depth": ["a"]}})
        >>> store = Store("run")
        >>> store.write_study(expected(plan(study, store)))
        >>> of_run(store.root).scene
        'spheres'
    """
    study = parse_study(Store(folder).read_study()["study"])
    scene = scene or study.scenes[0]
    one_of(scene, study.scenes, "scene")
    variants = {
        name: (variant, None if variant.geometry == "truth" else study.splats_of(variant))
        for name, variant in study.variants.items()
    }
    if not variants:
        raise InputError(
            f"{folder}: the study {study.name!r} has no variants; name a scene instead"
        )
    size = size or study.size
    targets = tuple(study.views) or tuple(world(scene, size).targets)
    return Subject(scene, size, study.spp, study.seeds[0], variants, targets)


def one_of(value: str, choices: list[str], name: str) -> None:
    """Refuse what is no choice, with the nearest one that is.

    Raises:
        InputError: ``value`` is none of ``choices``.

    Example:
        >>> one_of("papper", ["corrected", "paper"], "variant")
        Traceback (most recent call last):
        attnwarp.errors.InputError: variant: got 'papper'; did you mean 'paper'?; expected ...
    """
    if value not in choices:
        raise InputError(
            f"{name}: got {value!r}{suggest(value, choices)}; expected one of {', '.join(choices)}"
        )
