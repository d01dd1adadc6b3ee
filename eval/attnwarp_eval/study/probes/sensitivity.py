"""Which metric can see what: every metric on true results of an edit and on results with one known
flaw.

A scene's edit has a true result, so the pictures that a method should have made are known, and so
are pictures that it should not have made: an edit too weak, of a wrong colour, of a wrong thing,
another in each view, blurred, noisy or out of place. A metric that ranks the right one above the
flawed one can see that flaw; one that ranks them as a coin does is blind to it; and one that
prefers the flaw moves the wrong way.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from attnwarp.encoders import Kind, load_encoder
from attnwarp.errors import InputError
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.metrics.arrays import Array, Mask

if TYPE_CHECKING:
    from attnwarp_eval.cost import Meter
    from attnwarp_eval.scene.scene import Scene
    from attnwarp_eval.scene.spec import AnswerSpec, EditSpec
    from attnwarp_eval.truth import TwoView
    from attnwarp_eval.world import World

ANSWERS = 3
"""Of an edit with several right answers, the first that are rendered: one right, one wrong, and a
third for views that do not agree."""

RIGHT_ANSWERS = 2
"""Of these, how many are the right one in turn: more would only repeat what these show."""

STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Of the edit, as a blend of the pictures before and after in linear light."""

UNEVEN = (0.5, 0.75)
"""Strengths that the views of an inconsistent result take in turn, where the edit has one answer
alone.
"""

SATURATION = 0.75
"""Of a wrong colour (HSV): enough to be one on white marble too."""

BLUR = 2.0 / 256
"""Standard deviation of the blur, of the picture's side."""

NOISE = 0.05
"""Standard deviation of the noise, in sRGB of 1."""

SHIFT = 2
"""Pixels to the right by which a misplaced result lies off."""


@dataclass(frozen=True)
class Task:
    """One right result of one edit, and the other results that are wrong in its place.

    Attributes:
        edit, answer: which; ``answer`` is None for an edit with one result.
        source, target: the prompts, before and after.
        content: hash of the scene after the edit.
        others: (answer, hash) of other answers of the same edit.
        elsewhere: (edit, answer, hash) of an edit of other objects; None where the scene has none.
    """

    edit: str
    answer: str | None
    source: str
    target: str
    content: str
    others: tuple[tuple[str, str], ...] = ()
    elsewhere: tuple[str, str | None, str] | None = None

    @property
    def name(self) -> str:
        """``edit`` or ``edit-answer``."""
        return self.edit if self.answer is None else f"{self.edit}-{self.answer}"

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            **asdict(self),
            "others": [list(o) for o in self.others],
            "elsewhere": self.elsewhere and [*self.elsewhere],
        }

    @classmethod
    def from_dict(cls, said: Mapping[str, Any]) -> Task:
        """From what :meth:`to_dict` gave."""
        others = tuple((name, content) for name, content in said["others"])
        return cls(
            **{
                **said,
                "others": others,
                "elsewhere": said["elsewhere"] and tuple(said["elsewhere"]),
            }
        )


def tasks(scene: Scene, names: Sequence[str] = ()) -> list[Task]:
    """What is asked of a scene: each right result of each edit.

    Args:
        scene: with its edits.
        names: of the edits; all of the scene's if empty. Names that the scene lacks are passed
            over.
    """
    from attnwarp_eval.truth.edits import touched

    found = []
    for place, edit in enumerate(scene.edits):
        if names and edit.name not in names:
            continue
        answers: list[AnswerSpec | None] = list(edit.answers[:ANSWERS]) or [None]
        for answer in answers[:RIGHT_ANSWERS]:
            own = set(touched(scene, edit.name, answer.name if answer else None))
            others = [o.name for o in answers if o is not None and o is not answer]
            elsewhere = next(
                (
                    other.name
                    for other in (*scene.edits[place + 1 :], *scene.edits[:place])
                    if _objects(scene, other) and not own & _objects(scene, other)
                ),
                None,
            )
            found.append(
                Task(
                    edit.name,
                    answer.name if answer else None,
                    edit.source,
                    answer.target if answer else edit.target,
                    _content(scene, edit.name, answer.name if answer else None),
                    tuple((name, _content(scene, edit.name, name)) for name in others),
                    (
                        None
                        if elsewhere is None
                        else (elsewhere, None, _content(scene, elsewhere, None))
                    ),
                )
            )
    return found


def _objects(scene: Scene, edit: EditSpec) -> set[int]:
    """Objects whose surfaces an edit (its first answer) changes; none for an edit of the light."""
    from attnwarp_eval.scene.edits import pick
    from attnwarp_eval.truth.edits import touched

    return set() if (pick(edit) or edit).lights is not None else set(touched(scene, edit.name))


def _content(scene: Scene, edit: str, answer: str | None) -> str:
    return scene.edited(edit, answer).content_hash


@dataclass(frozen=True, eq=False)
class Shot:
    """What one view shows before the edit, after it, and after what would be wrong.

    Attributes:
        index: 0 for the source view, then the targets by their order.
        before, after: (H, W, 3) linear light in [0, 1].
        mask: (H, W) bool, the edited objects.
        hue: (3,) RGB of the wrong colour, its largest channel 1 and its smallest 0; the same in all
            views of a task.
        others: (H, W, 3) the results of other answers.
        elsewhere: (H, W, 3) the result of an edit of other objects.
    """

    index: int
    before: Array
    after: Array
    mask: Mask
    hue: Array
    others: tuple[Array, ...] = ()
    elsewhere: Array | None = None

    def blend(self, strength: float) -> Array:
        """(H, W, 3) linear light: the edit at part of its strength."""
        return (1 - strength) * self.before + strength * self.after

    def wrong_colour(self) -> Array:
        """Another answer, where the edit has several; else the edited object in the opposite hue,
        as light as it is.
        """
        if self.others:
            return self.others[0]
        value = self.after.max(axis=-1, keepdims=True)
        return np.where(self.mask[..., None], value * (1 - SATURATION * (1 - self.hue)), self.after)

    def inconsistent(self) -> Array:
        """Another answer in each view, or another strength."""
        if self.others:
            return self.others[self.index % len(self.others)]
        return self.blend(UNEVEN[self.index % len(UNEVEN)])

    def blurred(self) -> Array:
        """The right result out of focus."""
        from scipy.ndimage import gaussian_filter

        sigma = BLUR * self.after.shape[0]
        return np.asarray(gaussian_filter(self.after, (sigma, sigma, 0), mode="nearest"))

    def misplaced(self) -> Array:
        """The right result moved to the right; the left border is repeated."""
        return np.concatenate(
            [np.repeat(self.after[:, :1], SHIFT, axis=1), self.after[:, :-SHIFT]], axis=1
        )


@dataclass(frozen=True)
class Condition:
    """What a method may have given for a view.

    Attributes:
        name: the last part of a figure's key.
        title: for people, short.
        make: the picture in linear light; None where the edit has no such flaw.
        source: whether the source view has the flaw as well. Where it has, all views have it alike,
            and a metric that compares views with one another has nothing to find.
        noise: standard deviation of noise that is added to sRGB values, of its own in each view.
    """

    name: str
    title: str
    make: Callable[[Shot], Array | None]
    source: bool = True
    noise: float = 0.0

    def picture(self, shot: Shot, seed: int) -> Array | None:
        """(H, W, 3) sRGB of a view in [0, 1]."""
        linear = shot.after if shot.index == 0 and not self.source else self.make(shot)
        if linear is None or not self.noise:
            return None if linear is None else to_srgb(linear)
        rng = np.random.default_rng([seed, shot.index])
        return np.clip(to_srgb(linear) + rng.normal(0, self.noise, linear.shape), 0, 1)


def _strength(strength: float) -> Condition:
    return Condition(
        f"strength_{100 * strength:03.0f}",
        f"strength {strength:g}",
        lambda shot: shot.blend(strength),
    )


CONDITIONS = (
    *map(_strength, STRENGTHS),
    Condition("wrong_colour", "wrong colour", Shot.wrong_colour),
    Condition("wrong_object", "wrong object", lambda shot: shot.elsewhere),
    Condition("inconsistent", "inconsistent views", Shot.inconsistent, source=False),
    Condition("blurred", "blurred", Shot.blurred),
    Condition("noisy", "noisy", lambda shot: shot.after, noise=NOISE),
    Condition("misplaced", f"misplaced by {SHIFT} px", Shot.misplaced, source=False),
)
"""Every condition; the right result is that of full strength."""

RIGHT = f"strength_{100 * STRENGTHS[-1]:03.0f}"

FIDELITY = (
    *(
        f"fidelity.{name}{place}"
        for place in ("", ".inside")
        for name in ("mse", "psnr", "ssim", "distance")
    ),
    *(f"fidelity.preserved_{name}" for name in ("mse", "psnr", "ssim", "distance")),
)
"""What is kept of :func:`attnwarp_eval.metrics.fidelity`."""

CONSISTENCY = ("consistency.delta_e", "consistency.rmse_srgb", "consistency.pixels")
"""What is kept of :func:`attnwarp_eval.metrics.cross_view`: of the edited object, against the
source view.
"""


def identity(name: str, kind: Kind) -> dict[str, Any]:
    """What of an encoder decides its figures: its weights and what happens to a picture before,
    wherever it lies.

    Raises:
        InputError: see :func:`attnwarp.encoders.load_encoder`.
    """
    return identity_of(load_encoder(name, kind))


def identity_of(encoder: Any) -> dict[str, Any]:
    """:func:`identity` of an encoder that is loaded."""
    about = encoder.about.to_dict()
    return {key: about[key] for key in ("kind", "weights_sha256", "preprocessing", "size", "dim")}


def loaded(names: Mapping[str, str], expected: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Encoders by kind.

    Args:
        names: by kind, as :func:`attnwarp.encoders.load_encoder` takes them.
        expected: by kind, the :func:`identity` that they had when the run was planned.

    Raises:
        InputError: one cannot be loaded, or is another one by now.
    """
    found = {}
    for kind, wanted in expected.items():
        found[kind] = load_encoder(names[kind])
        if identity_of(found[kind]) != wanted:
            raise InputError(
                f"encoder {names[kind]!r}: its weights have changed since the run was planned;"
                " start the run again"
            )
    return found


def measure(
    at: World,
    spec: Mapping[str, Any],
    encoders: Mapping[str, Any],
    meter: Meter,
    seconds: dict[str, list[float]],
) -> Iterator[tuple[str, dict[str, float], dict[str, Any]]]:
    """Every metric on every condition of every task.

    Args:
        at: the scene.
        spec: of the cell: ``views``, ``tasks``, ``spp``, ``seed``, ``rounds``.
        encoders: loaded, by kind; metrics whose encoder is not there are left out.
        meter: takes the seconds of truth and checks.
        seconds: filled with the seconds that a picture costs each metric, taken in turn: a list of
            rounds each.

    Yields:
        ``task/view``, its figures as ``metric.condition``, and {}.
    """
    for number, task in enumerate(map(Task.from_dict, spec["tasks"])):
        with meter.stage("truth"):
            shots = _shots(at, task, spec)
            source = {c.name: c.picture(shots[at.source.name], spec["seed"]) for c in CONDITIONS}
        prompts = _Prompts(task, source[RIGHT], encoders)
        for name in spec["views"]:
            with meter.stage("truth"):
                pair = at.pair(name, spec["size"])
                shot = shots[name]
                pictures = {c.name: c.picture(shot, spec["seed"]) for c in CONDITIONS}
                view = _View(pair, shot, shots[at.source.name])
            with meter.stage("checks"):
                figures: dict[str, float] = {}
                for condition, picture in pictures.items():
                    if picture is not None:
                        found = view.figures(source[condition], picture, encoders.get("perceptual"))
                        figures |= {f"{key}.{condition}": value for key, value in found.items()}
                figures |= prompts.figures(view.original, pictures)
                known = {key.rpartition(".")[0] for key in figures}
                for condition, picture in pictures.items():
                    if picture is None:  # said to be undefined, and so counted
                        figures |= {f"{key}.{condition}": math.nan for key in known}
            meter.count(pictures=len(pictures))
            if number == 0 and name == spec["views"][0]:
                with meter.stage("rounds"):
                    seconds |= _rounds(
                        view, prompts, source["noisy"], pictures["noisy"], encoders, spec
                    )
            yield f"{task.name}/{name}", figures, {}


def _shots(at: World, task: Task, spec: Mapping[str, Any]) -> dict[str, Shot]:
    """The source and every target by name."""
    from attnwarp_eval.truth import appearance
    from attnwarp_eval.truth.edits import edit_mask

    names = [at.source.name, *spec["views"]]
    scenes = [at.scene, at.scene.edited(task.edit, task.answer)]
    scenes += [at.scene.edited(task.edit, answer) for answer, _ in task.others]
    if task.elsewhere is not None:
        scenes.append(at.scene.edited(*task.elsewhere[:2]))
    # Scene by scene: Mitsuba keeps the last one, and to load one costs more than to render it.
    seen: dict[str, list[Array]] = {name: [] for name in names}
    for scene in scenes:
        for name in names:
            seen[name].append(
                np.clip(appearance(scene, at.camera(name), spp=spec["spp"], seed=0), 0, 1)
            )
    masks = {
        name: edit_mask(at.scene, task.edit, at.geometry.trace(at.camera(name)), task.answer)
        for name in names
    }
    total = np.sum(
        [seen[name][1][masks[name]].sum(axis=0, dtype=np.float64) for name in names], axis=0
    )
    hue = opposite_hue(total)
    last = 2 + len(task.others)
    return {
        name: Shot(
            index, seen[name][0], seen[name][1], masks[name], hue, tuple(seen[name][2:last]),
            seen[name][last] if task.elsewhere is not None else None,
        )
        for index, name in enumerate(names)
    }  # fmt: skip


def opposite_hue(color: Array) -> Array:
    """(3,) RGB of the hue half a circle from that of a colour, fully saturated (HSV); red for
    grey."""
    spread = color.max() - color.min()
    return np.array([1.0, 0, 0]) if spread <= 1e-9 * color.max() else (color.max() - color) / spread


class _View:
    """A view with all that metrics of pictures need to judge one that somebody made of it."""

    def __init__(self, pair: TwoView, shot: Shot, source: Shot) -> None:
        from attnwarp_eval.metrics import view_dependent

        self.pair = pair
        self.mask = shot.mask
        self.original, self.truth = to_srgb(shot.before), to_srgb(shot.after)
        # What rightly differs between two views, before the edit or after it: highlights and
        # reflections.
        self.exclude = view_dependent(to_srgb(source.before), self.original, pair)
        self.exclude |= view_dependent(to_srgb(source.after), self.truth, pair)

    def figures(self, source: Array | None, picture: Array, perceptual: Any) -> dict[str, float]:
        """The figures of pictures that are kept."""
        from attnwarp_eval.metrics import fidelity

        distance = None if perceptual is None else _distance(perceptual)
        against = fidelity(
            picture, self.truth, self.mask, original_srgb=self.original, distance=distance
        )
        between = self.consistency(source, picture)
        return {
            **{key: against[key] for key in FIDELITY if key in against},
            **{key: between[key] for key in CONSISTENCY},
        }

    def consistency(self, source: Array | None, picture: Array) -> dict[str, float]:
        """Of the edited object in the picture and in the source view of the same result."""
        from attnwarp_eval.metrics import cross_view

        return cross_view(
            source, picture, self.pair, mask=self.mask, exclude=self.exclude
        ).figures()


def _distance(perceptual: Any) -> Callable[[Array, Array], float]:
    return lambda a, b: float(perceptual.distance([a], [b])[0])


class _Prompts:
    """A task's prompts and its edited source view as encoders see them: made once, for all
    pictures.
    """

    def __init__(self, task: Task, source_edit: Array | None, encoders: Mapping[str, Any]) -> None:
        self.clip, self.dino = encoders.get("clip"), encoders.get("dino")
        if self.clip is not None:
            self.before, self.after = self.clip.texts([task.source, task.target])
            self.clip_source = self.clip.images([source_edit])
        if self.dino is not None:
            self.dino_source = self.dino.images([source_edit])

    def figures(self, original: Array, pictures: Mapping[str, Array | None]) -> dict[str, float]:
        """``embedding.*.condition`` of all conditions that there are."""
        from attnwarp_eval.metrics import clip_similarity, directional_similarity, image_similarity

        there = {
            condition: picture for condition, picture in pictures.items() if picture is not None
        }
        found: dict[str, Array] = {}
        if self.clip is not None:
            *images, unedited = self.clip.images([*there.values(), original])
            images = np.stack(images)
            found["clip_similarity"] = clip_similarity(images, self.after).values
            befores = np.broadcast_to(unedited, images.shape)
            found["clip_directional"] = directional_similarity(
                befores, images, self.before, self.after
            ).values
            found["clip_image"] = image_similarity(self.clip_source, images).values
        if self.dino is not None:
            found["dino_image"] = image_similarity(
                self.dino_source, self.dino.images(list(there.values()))
            ).values
        return {
            f"embedding.{name}.{condition}": float(value)
            for name, values in found.items()
            for condition, value in zip(there, values, strict=True)
        }


def _rounds(
    view: _View,
    prompts: _Prompts,
    source: Array | None,
    picture: Array | None,
    encoders: Mapping[str, Any],
    spec: Mapping[str, Any],
) -> dict[str, list[float]]:
    """Seconds that one picture costs each metric, in turn in an order drawn anew each round; a
    first round is not kept.

    What is made once for all pictures is in none of them: truth, correspondences, and the
    embeddings of the prompts, of the edited source view and of the view before the edit.
    """
    from attnwarp_eval import metrics

    contestants: dict[str, Callable[[], Any]] = {
        "fidelity.mse": lambda: metrics.mse(picture, view.truth),
        "fidelity.ssim": lambda: metrics.ssim(picture, view.truth),
        "consistency.delta_e": lambda: view.consistency(source, picture),  # type: ignore[arg-type]
    }
    if (perceptual := encoders.get("perceptual")) is not None:
        contestants["fidelity.distance"] = lambda: perceptual.distance([picture], [view.truth])
    if (clip := prompts.clip) is not None:
        before = clip.images([view.original])
        contestants["embedding.clip_similarity"] = lambda: metrics.clip_similarity(
            clip.images([picture]), prompts.after
        )
        contestants["embedding.clip_directional"] = lambda: metrics.directional_similarity(
            before, clip.images([picture]), prompts.before, prompts.after
        )
        contestants["embedding.clip_image"] = lambda: metrics.image_similarity(
            prompts.clip_source, clip.images([picture])
        )
    if (dino := prompts.dino) is not None:
        contestants["embedding.dino_image"] = lambda: metrics.image_similarity(
            prompts.dino_source, dino.images([picture])
        )
    names = list(contestants)
    taken: dict[str, list[float]] = {name: [] for name in names}
    rng = np.random.default_rng(spec["seed"])
    for turn in range(spec["rounds"] + 1):
        for index in rng.permutation(len(names)):
            start = time.perf_counter()
            contestants[names[index]]()
            if turn:
                taken[names[index]].append(time.perf_counter() - start)
    return taken
