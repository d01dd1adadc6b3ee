"""Measurement of the bounces of light that a scene needs: `attnwarp-eval scenes calibrate`.

The result is the fewest bounces whose pictures are shown to have, in every view, the light of
pictures with unlimited bounces within :data:`MARGIN`: |d| + t SE of the mean over pairs of pictures
of one seed, with t the 99 % quantile of Student's distribution (two one-sided tests, Schuirmann
1987). Every view must pass, so no correction for the number of views is needed; a number that is
too small passes with a chance of at most 1 % for each of the :data:`SAMPLES` tried. If noise or
light prevents every number up to :data:`MOST` from passing, bounces are unlimited.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.scene import transport
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.statistics.equivalence import paired_test
from attnwarp_eval.truth.mitsuba import build, comparable, render_plan
from attnwarp_eval.truth.passes import Bounces, convex, plan_passes

Array = npt.NDArray[np.float64]

MARGIN = 0.01
"""Tolerated loss of light in a view's picture, as a share of its mean: the proofs' margin."""

CONFIDENCE = 0.99

SIZE, BLOCK = 32, 8
"""Pixels along a side of the measured pictures, and of their blocks."""

PAIRS = 16
"""Pairs of pictures of a view. One rendering makes them all, with a cell of each pixel for each
pair, since starting a rendering takes longer than so few samples; hence a square number."""

SAMPLES = (4, 16, 64, 256)
"""Samples a pixel, more if fewer cannot decide."""

TEXELS = 512
"""Most texels along a side of a baked texture: four for each cell of the pictures."""

AT_ONCE = 64
"""Most samples of a rendering: more would take gigabytes."""

FIRST, MOST = 2, 12
"""The first number of bounces tried, and the largest."""


@dataclass(frozen=True)
class Shortfall:
    """Light that a number of bounces loses, in the least certain view.

    Attributes:
        spp: samples a pixel.
        difference, error: light with unlimited bounces minus that of the pictures, and its standard
            error, as shares of the mean.
        bound: |difference| + t SE.
        block: the largest difference of the mean of an 8 x 8 block, as a share of the picture's
            mean; may be mostly noise.
    """

    bounces: int
    view: str
    spp: int
    difference: float
    error: float
    bound: float
    block: float

    @property
    def holds(self) -> bool:
        """True if the light is shown to be complete within the margin."""
        return self.bound < MARGIN


@dataclass(frozen=True)
class Answer:
    """Number of bounces that a scene needs, and the evidence.

    Attributes:
        bounces: number of bounces; "unlimited" if none up to :data:`MOST` is shown to suffice.
        held: light that this number loses, in the view with the largest bound; None
            without a measurement.
        fewer: light that one bounce fewer loses, in the view that refused it; None without such a
            view.
        made_by: Mitsuba's version and variant; None without a measurement.
    """

    bounces: Bounces
    held: Shortfall | None
    fewer: Shortfall | None
    made_by: str | None

    @property
    def words(self) -> str:
        """The number and the evidence, for a person."""
        if self.made_by is None:
            return "a single convex surface never lights itself"
        out = []
        if self.held is not None:
            out.append(
                f"{self.held.bounces} {_leave(self.held)} {self.held.difference:.2%} of a view's"
                f" light ({self.held.view}; below {self.held.bound:.2%})"
            )
        if self.fewer is not None:
            out.append(
                f"{self.fewer.bounces} {_leave(self.fewer)} {self.fewer.difference:.2%}"
                f" ({self.fewer.view})"
            )
        # A space before the sign, as everywhere.
        words = ", ".join(out).replace("%", " %")
        return words if self.held else f"no number suffices, light has no end: {words}"


def _leave(shortfall: Shortfall) -> str:
    return "leaves out" if shortfall.bounces == 1 else "leave out"


# Measuring
# --------------------------------------------------------------------------------------------------

Pictures = Callable[[Bounces, Camera, int], Array]
"""(PAIRS, H, W, 3) pictures for a number of bounces, a view and samples a pixel."""


def search(scene: Scene) -> Answer:
    """Measure how many bounces ``scene`` needs, regardless of its file.

    Renders about a hundred pictures of 32 x 32 in about ten seconds.

    Example:
        A single ball on nothing never lights itself, so nothing is measured.

        >>> from attnwarp_eval.scene.spec import SceneSpec
        >>> view = {"yaw": 0, "height": 1}
        >>> ball = {"type": "sphere", "center": [0, 0, 0], "radius": 1}
        >>> spec = SceneSpec.model_validate({
        ...     "name": "ball", "title": "A ball",
        ...     "objects": [{"name": "ball", "shape": ball,
        ...                  "texture": {"type": "plain", "color": "#808080"}}],
        ...     "lights": [{"type": "sun", "elevation": 40, "azimuth": 0, "irradiance": 2}],
        ...     "cameras": {"look_at": [0, 0, 0], "radius": 3, "source": view,
        ...                 "targets": [{"yaw": 90, "height": 1}]}})
        >>> search(Scene(spec)).bounces
        1
    """
    import mitsuba

    if convex(scene) and scene.spec.medium is None:
        return Answer(1, None, None, None)
    small = scene.with_size(SIZE, SIZE)
    made_by = f"{mitsuba.__version__} {comparable(small)}"
    pictures = pictures_of(small)
    views = list(small.cameras)

    def try_all(bounces: int) -> Shortfall:
        """Shortfall of the least certain view, or of the first that refuses the number."""
        worst: Shortfall | None = None
        for view in list(views):
            tried = shortfall(pictures, bounces, view)
            if not tried.holds:
                # This view is tried first for the next number.
                views.remove(view)
                views.insert(0, view)
                return tried
            if worst is None or tried.bound > worst.bound:
                worst = tried
        assert worst is not None
        return worst

    least = transport.fewest_bounces(scene.spec)
    number = max(least, FIRST)
    last, fewer = try_all(number), None
    # Fewer bounces leave out more light, so numbers below a refused one are not tried.
    while not last.holds and number < MOST:
        number, fewer, last = number + 1, last, try_all(number + 1)
    if not last.holds:
        return Answer("unlimited", None, last, made_by)
    while fewer is None and number > least:
        below = try_all(number - 1)
        if below.holds:
            number, last = number - 1, below
        else:
            fewer = below
    return Answer(number, last, fewer, made_by)


def worlds(scene: Scene) -> Iterator[Scene]:
    """The scene, then each of its edited scenes."""
    yield scene
    for edit in scene.edits:
        for answer in edit.answers or (None,):
            yield scene.edited(edit.name, answer.name if answer else None)


def shortfall(pictures: Pictures, bounces: int, view: Camera) -> Shortfall:
    """Shortfall of a number of bounces in a view, with as many samples as the decision takes.

    Example:
        >>> def pictures(bounces, view, spp):
        ...     noise = np.random.default_rng(spp).normal(0, 0.01, (PAIRS, 8, 8, 3))
        ...     return noise + (1.0 if bounces == "unlimited" else 1 - 0.05**bounces)
        >>> view = Camera.look_at((0, 0, 3), (0, 0, 0), width=8, height=8, fov_y=45, up=(0, 1, 0))
        >>> [shortfall(pictures, bounces, view).holds for bounces in (1, 2)]
        [False, True]
    """
    from scipy import stats

    for spp in SAMPLES:
        ours, endless = (pictures(b, view, spp) for b in (bounces, "unlimited"))
        test = paired_test(ours, endless)
        reach = float(stats.t.ppf(CONFIDENCE, PAIRS - 1)) * test.error
        bound = abs(test.difference) + reach
        apart = (endless - ours).mean((0, 3))
        blocks = apart.reshape(len(apart) // BLOCK, BLOCK, -1, BLOCK).mean((1, 3))
        block = float(np.abs(blocks).max()) / max(float(endless.mean()), 1e-300)
        if bound < MARGIN or abs(test.difference) - reach >= MARGIN:
            break
    return Shortfall(bounces, view.name, spp, test.difference, test.error, bound, block)


def pictures_of(scene: Scene, seed: int = 300_000) -> Pictures:
    """Pictures of ``scene`` for :func:`shortfall`, from ``seed`` on; rendered pictures are kept."""
    made_by = comparable(scene)
    side = math.isqrt(PAIRS)

    @functools.cache
    def pictures(bounces: Bounces, name: str, spp: int) -> Array:
        # Both of a pair have one seed: in a variant with separate random numbers for each sample
        # the light of the first bounces is then the same.
        parts = max(1, spp // AT_ONCE)
        planned, camera = plan_passes(scene, spp // parts, bounces), scene.camera(name)
        fine = camera.resize(side * camera.width, side * camera.height)
        with build.at_most_texels(TEXELS):
            rendered = [
                render_plan(scene, fine, planned, seed + k, made_by=made_by) for k in range(parts)
            ]
        return dealt(np.mean(rendered, axis=0, dtype=np.float64))

    return lambda bounces, view, spp: pictures(bounces, view.name, spp)


def dealt(fine: Array) -> Array:
    """(PAIRS, H, W, 3) pictures from one whose pixels have PAIRS cells each.

    The assignment of a pixel's cells to pictures is random but the same at each call. So all
    pictures have the same expected pixels, and the spread of their means slightly overstates the
    error of their mean, if at all: cells of one pixel differ more than its samples would.

    Args:
        fine: (H * side, W * side, 3), side the square root of PAIRS.

    Example:
        >>> pictures = dealt(np.arange(8 * 8 * 3.0).reshape(8, 8, 3))
        >>> pictures.shape, bool((np.sort(pictures[:, 0, 0, 0]) == 3 * np.array(
        ...     [[8 * row + column for column in range(4)] for row in range(4)]).ravel()).all())
        ((16, 2, 2, 3), True)
    """
    side = math.isqrt(PAIRS)
    height, width = fine.shape[0] // side, fine.shape[1] // side
    cells = fine.reshape(height, side, width, side, 3).transpose(1, 3, 0, 2, 4)
    order = np.random.default_rng(0).random((PAIRS, height, width, 1)).argsort(axis=0)
    return np.take_along_axis(cells.reshape(PAIRS, height, width, 3), order, axis=0)
