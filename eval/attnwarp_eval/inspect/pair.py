"""A pair of views under one variant: its warp, its truth if available, and its colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from attnwarp import Camera, Gaussians
from attnwarp.render import render
from attnwarp.warp import (
    RULES,
    FeatureWarp,
    Surface,
    WarpedView,
    WarpSettings,
    depth_tolerance,
    parts_of,
    parts_read,
    render_surface,
    sample,
    sample_depth,
    warp_surfaces,
    warp_view,
)
from attnwarp.warp.view import near_plane
from attnwarp_eval.inspect.capture import Capture, Edit, rendered
from attnwarp_eval.inspect.run import RunEdit
from attnwarp_eval.study.shared import pictures
from attnwarp_eval.two_view import AMBIGUOUS, HIDDEN, NONE, VISIBLE, TwoView

if TYPE_CHECKING:
    from attnwarp_eval.world import World

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Legend = list[tuple[str, str]]
Size = tuple[int, int]

LABELS = {NONE: "none", VISIBLE: "visible", HIDDEN: "hidden", AMBIGUOUS: "ambiguous"}

EDIT_DISAGREEMENT = "edit disagreement"

COLORINGS = (
    "picture",
    "mask",
    "rules",
    "endpoint error",
    "depth error",
    "incidence",
    EDIT_DISAGREEMENT,
)
"""Colourings of the target's surface; :attr:`Pair.colorings` has those that a pair can show."""

NEEDS_TRUTH = ("endpoint error", "depth error")

ACCEPTED, REJECTED = "#2ca25f", "#4a4a4a"

CATEGORIES = (
    "#1f78b4", "#e31a1c", "#17becf", "#ff7f00", "#6a3d9a", "#b15928", "#a6cee3", "#fb9a99",
    "#b2df8a", "#fdbf6f", "#cab2d6", "#ffd92f",
)  # fmt: skip
"""Colours of rules, in order (ColorBrewer, Paired; its dark green resembles
``ACCEPTED``, so cyan replaces it)."""

DISAGREEMENT = 0.3
"""Mean absolute difference of sRGB at the bright end of the colours."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The surface seen by the target's pixels.

    Attributes:
        point: (H, W, 3) world coordinates, NaN where there is none.
        depth: (H, W) along the target's axis.
        normal: (H, W, 3) world, of either sign.
        owner: (H, W) number of the object, all 0 without truth.
        valid: (H, W) bool.
    """

    point: Array
    depth: Array
    normal: Array
    owner: npt.NDArray[Any]
    valid: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Pair:
    """One target view against the source, under one variant.

    Args:
        views: a scene with truth, or a user's capture.
        model: the splats that give depth; None takes the true depth.
        exact_mask: whether the mask is the exact one, as for an oracle.
    """

    views: World | Capture
    target: str
    settings: WarpSettings
    model: Gaussians | None
    spp: int = 8
    edit: Edit | RunEdit | None = None
    exact_mask: bool = False

    @property
    def world(self) -> World | None:
        """The scene's truth; None for a user's capture."""
        return None if isinstance(self.views, Capture) else self.views

    def near(self, model: Gaussians) -> float:
        """Near-plane depth of splats in the target, in scene units."""
        if isinstance(self.views, Capture):
            return self.views.near
        return near_plane(model, self.cameras[1])

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """Source and target."""
        return self.views.source, self.views.targets[self.target]

    @property
    def size(self) -> Size:
        """(H, W) of the target."""
        return self.cameras[1].height, self.cameras[1].width

    @cached_property
    def truth(self) -> TwoView | None:
        """Exact correspondences and visibility."""
        if self.world is None:
            return None
        return self.world.pair(self.target, self.world.source.height)

    def truth_at(self, size: Size) -> TwoView | None:
        """The truth on a feature grid (h, w); None if unknown."""
        if self.world is None or size[0] != size[1]:
            return None
        return self.world.pair(self.target, size[0])

    @cached_property
    def images(self) -> tuple[Image, Image]:
        """(H, W, 3) sRGB of the source and of the target before any edit."""
        views, names = self.views, (self.views.source.name, self.target)
        if isinstance(views, Capture):
            return views.image(names[0]), views.image(names[1])
        return views.image(names[0], self.spp), views.image(names[1], self.spp)

    @cached_property
    def surfaces(self) -> tuple[Surface, Surface]:
        """Surfaces of source and target, as inputs of the warp."""
        source, target = self.cameras
        if isinstance(self.views, Capture):
            return (
                self.views.surface(source.name, self.settings),
                self.views.surface(target.name, self.settings),
            )
        if self.model is not None:
            return (
                render_surface(self.model, source, self.settings),
                render_surface(self.model, target, self.settings),
            )
        source_hits = self.views.geometry.trace(source)
        target_hits = self.views.geometry.trace(target)
        return (
            Surface(source_hits.depth, source_hits.normal, image=self.images[0]),
            Surface(target_hits.depth, target_hits.normal, image=self.images[1]),
        )

    @cached_property
    def view(self) -> WarpedView:
        """The warp and its mask."""
        view = self._warped_view()
        if not self.exact_mask or self.truth is None:
            return view
        visible = torch.from_numpy(np.ascontiguousarray(self.truth.visible))
        return view.with_mask(visible)

    def _warped_view(self) -> WarpedView:
        source, target = self.cameras
        source_image, target_image = self.images
        if self.model is None or self.settings.gaussian_filter == "none":
            own = replace(self.surfaces[0], image=source_image)
            seen = replace(self.surfaces[1], image=target_image)
            return warp_surfaces(source, target, seen, own, self.settings, warn_empty=False)
        reads: dict[str, Any] = {}
        if "source_image" in parts_read(self.settings):
            reads = {"source_image": source_image, "target_image": target_image}
        return warp_view(
            self.model,
            source,
            target,
            self.settings,
            source_surface=self.surfaces[0],
            near=self.near(self.model),
            **reads,
            warn_empty=False,
        )

    @cached_property
    def seen(self) -> Seen:
        """The surface seen by the target: the true one, or that of the splats."""
        if self.truth is not None:
            hits = self.truth.hits
            return Seen(hits.point, hits.depth, hits.normal, hits.object_id, hits.valid)
        surface, target = self.surfaces[1], self.cameras[1]
        depth = np.asarray(surface.depth, dtype=np.float64)
        if surface.alpha is not None and self.settings.opaque is not None:
            opaque = np.asarray(surface.alpha) >= self.settings.opaque
            depth = np.where(opaque, depth, np.nan)
        valid = np.isfinite(depth)
        point = target.unproject(target.pixel_centers(), depth)
        normal = np.asarray(surface.normal, dtype=np.float64)
        return Seen(point, depth, normal, np.zeros(depth.shape, int), valid)

    @cached_property
    def depths(self) -> Mapping[str, Array]:
        """(H, W) depth of the target by each definition, NaN where undefined."""
        maps = {"of the warp": self.view.correspondence.target_depth.numpy()}
        if self.truth is not None:
            maps["truth"] = self.truth.hits.depth
        if self.model is not None:
            for depth in ("intersection", "center"):
                how = "peak" if depth == "intersection" and self.model.kind == "3d" else depth
                with torch.no_grad():
                    result = render(
                        self.model, self.cameras[1], depth=how, near=self.near(self.model)
                    )
                maps[f"{depth}, expected"] = result.depth.double().numpy()
                maps[f"{depth}, median"] = result.median_depth.double().numpy()
        return maps

    @cached_property
    def source_depth(self) -> Array:
        """(H, W) depth of the source's surface at the warp's positions; NaN if none."""
        depth = torch.as_tensor(np.asarray(self.surfaces[0].depth, dtype=np.float64))
        spread = self.settings.depth_spread
        return sample_depth(depth, self.view.correspondence, spread=spread).numpy()

    @cached_property
    def tolerance(self) -> Array:
        """(H, W) largest difference of depths that counts as agreement."""
        s = self.settings
        return depth_tolerance(
            self.view.correspondence,
            self.surfaces[0].depth,
            relative=s.depth_relative,
            slope=s.depth_slope,
        ).numpy()

    @cached_property
    def margins(self) -> Mapping[str, tuple[Array, str]]:
        """(H, W) margin of each rule's pixels to the other verdict, and its unit.

        Positive where the rule passes, NaN where the quantity is undefined.
        """
        view = self.view
        parts = parts_of(view.target, view.source)
        margins = {}
        for rule in RULES:
            if rule.name in view.rules:
                distance = np.full(self.size, np.nan)
                if rule.margin is not None:
                    arguments = rule.arguments(self.settings, parts)
                    distance = rule.margin(view.correspondence, **arguments).numpy()
                margins[rule.name] = distance, rule.unit
        return margins

    @cached_property
    def incidence(self) -> Array:
        """(H, W) degrees between the surface's normal and the direction to the source camera.

        The normal is the true one, or the splats' turned to the target.
        """
        source, target = self.cameras
        seen = self.seen
        to_target = target.position - seen.point
        away = np.einsum("hwi,hwi->hw", seen.normal, to_target) < 0
        normal = np.where(away[..., None], -seen.normal, seen.normal)
        to_source = source.position - seen.point
        lengths = np.linalg.norm(to_source, axis=-1) * np.linalg.norm(normal, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = np.einsum("hwi,hwi->hw", normal, to_source) / lengths
        return np.degrees(np.arccos(np.clip(cosine, -1, 1)))

    @cached_property
    def first_rejection(self) -> npt.NDArray[np.int64]:
        """(H, W) number of the first rule that rejects the pixel; -1 if none does."""
        passed = np.stack([mask.numpy() for mask in self.view.rules.values()])
        return np.where(passed.all(axis=0), -1, passed.argmin(axis=0))

    @cached_property
    def disagreement(self) -> Array:
        """(H, W) mean absolute difference of the target's edit and the source's, warped.

        NaN where the mask rejects, and in views without an edit.
        """
        edited = self._edited(self.views.source.name), self._edited(self.target)
        if edited[0] is None or edited[1] is None:
            return np.full(self.size, np.nan)
        source = torch.as_tensor(np.asarray(edited[0], dtype=np.float64)).permute(2, 0, 1)
        warped = sample(source, self.view.correspondence)[0].permute(1, 2, 0).numpy()
        difference = np.abs(warped - edited[1]).mean(axis=2)
        return np.where(self.view.mask.numpy(), difference, np.nan)

    def _edited(self, name: str) -> Image | None:
        """(H, W, 3) the edit of a view, at its camera's size."""
        picture = None if self.edit is None else self.edit.edited(name)
        return None if picture is None else fitted(picture, self.views.camera(name))

    # --- feature grids

    @cached_property
    def layers(self) -> tuple[Size, ...]:
        """(h, w) of feature grids that the images divide into: an eighth, a sixteenth, ..."""
        source, target = self.cameras
        sizes = []
        for factor in (4, 8, 16, 32, 64):
            sides = (target.height, target.width, source.height, source.width)
            if all(side % factor == 0 for side in sides) and min(sides) >= 2 * factor:
                sizes.append((target.height // factor, target.width // factor))
        return tuple(sorted(sizes, reverse=True))

    def layer(self, size: Size) -> FeatureWarp:
        """The warp of an (h, w) feature grid."""
        return self.view.at(size)

    def mask(self, layer: Size | None = None) -> npt.NDArray[np.bool_]:
        """(H, W) the mask, or that of a feature grid with its cells as blocks of pixels."""
        if layer is None:
            return self.view.mask.numpy()
        return blocks(self.layer(layer).mask.numpy(), self.size)

    # --- colours

    @property
    def colorings(self) -> tuple[str, ...]:
        """The :data:`COLORINGS` available for this pair."""
        return tuple(
            name
            for name in COLORINGS
            if (self.truth is not None or name not in NEEDS_TRUTH)
            and (self.edit is not None or name != EDIT_DISAGREEMENT)
        )

    def colors(self, coloring: str, layer: Size | None = None, step: str | None = None) -> Image:
        """(H, W, 3) sRGB colours of the target's pixels.

        Args:
            coloring: one of :attr:`colorings`.
            layer: (h, w) of a feature grid, whose mask "mask" then shows.
            step: step of the edit, whose scene "picture" then shows.
        """
        if coloring not in self.colorings:
            raise ValueError(
                f"coloring: got {coloring!r}, expected one of {', '.join(self.colorings)}"
            )
        truth, target = self.truth, self.images[1]
        if coloring == "picture":
            return self.picture(step)
        if coloring == "mask":
            if truth is not None:
                return pictures.mask_against_truth(self.mask(layer), truth, target)
            mask = self.mask(layer)
            return tinted([ACCEPTED, REJECTED], np.where(mask, 0, 1), target)
        if coloring == "rules":
            return tinted([*CATEGORIES, ACCEPTED], self.first_rejection, target)
        if coloring == "incidence":
            return incidence_map(self.incidence)
        if coloring == EDIT_DISAGREEMENT:
            return disagreement_map(self.disagreement)
        assert truth is not None
        if coloring == "endpoint error":
            return pictures.endpoint_map(self.view.correspondence.xy.numpy(), truth)
        depth = np.asarray(self.surfaces[1].depth, dtype=np.float64)
        return pictures.depth_map(depth, truth.hits)

    def legend(self, coloring: str) -> Legend:
        """(text, "#rrggbb") of the colours' meanings."""
        if coloring == "mask":
            if self.truth is None:
                return [("accepted", ACCEPTED), ("rejected", REJECTED)]
            return [(name, color) for name, (color, _) in pictures.CLASSES.items()]
        if coloring == "rules":
            rules = [
                (f"rejected by {rule}", CATEGORIES[number])
                for number, rule in enumerate(self.view.rules)
            ]
            return [("accepted", ACCEPTED), *rules]
        if coloring == "endpoint error":
            low, high = pictures.EPE_RANGE
            values = np.geomspace(low, high, 4)
            scale = _scale("viridis", [f"{value:g} px" for value in values])
            return [*scale, ("no position", "#b2182b")]
        if coloring == "depth error":
            limit = pictures.DEPTH_RANGE
            return _scale("RdBu_r", [f"{v:+.0%} of depth" for v in np.linspace(-limit, limit, 5)])
        if coloring == "incidence":
            return _scale("viridis_r", [f"{v:.0f} degrees" for v in np.linspace(0, 90, 4)])
        if coloring == EDIT_DISAGREEMENT:
            values = np.linspace(0, DISAGREEMENT, 4)
            return [*_scale("magma", [f"{v:.1f} of sRGB" for v in values]), ("no warp", "#999999")]
        return []

    def picture(self, step: str | None = None) -> Image:
        """(H, W, 3) the target's picture, or the render of the scene after a step of its edit."""
        if self.edit is None or step in (None, self.edit.steps[0]):
            return self.images[1]
        target = self.cameras[1]
        assert step is not None
        made = self.edit.after(self.target, step)
        if made is not None:
            return fitted(made, target)
        splats = self.splats(step)
        return rendered(splats, target, self.near(splats))

    def splats(self, step: str = "") -> Gaussians:
        """The splats after a step of the edit; those before it if a run has no others.

        Only for a pair with splats.
        """
        assert self.model is not None
        if self.edit is None or step in ("", self.edit.steps[0]):
            return self.model
        after = self.edit.splats(step)
        return self.model if after is None else after

    def insets(self, layer: Size | None = None, step: str | None = None) -> dict[str, Image]:
        """The pictures next to the 3D view, by title.

        Args:
            layer: (h, w) of a feature grid, whose cells the warped pictures then have.
        """
        source, target = self.images
        parts = {"source": source, "target": target}
        if self.edit is not None:
            names = {"source": self.views.source.name, "target": self.target}
            for part, name in names.items():
                edited = self._edited(name)
                before = parts.pop(part)
                title = f"{part}, not edited" if edited is None else f"{part}, edited"
                parts[title] = before if edited is None else edited
            parts[f"scene, {step or self.edit.steps[0]}"] = self.picture(step)
        parts["source, warped"] = self._warped(next(iter(parts.values())), layer)
        title = "mask" if self.truth is None else "mask against truth"
        parts[title] = self.colors("mask", layer)
        if isinstance(self.edit, RunEdit):
            parts |= self.edit.details(self.target)
        return parts

    def _warped(self, source: Image, layer: Size | None) -> Image:
        warp = self.layer(layer or self.size)
        small = fitted(source, warp.correspondence.source)
        image = warp.warp(torch.from_numpy(np.ascontiguousarray(small.transpose(2, 0, 1))))
        large = blocks(image.permute(1, 2, 0).numpy(), self.size)
        mask = self.mask(layer)[..., None]
        return np.where(mask, large, pictures.checkered(self.size)).astype(np.float32)


def fitted(picture: Image, camera: Camera) -> Image:
    """A picture at a camera's size: averaged where it shrinks, cubic where it grows."""
    if picture.shape[:2] == (camera.height, camera.width):
        return picture
    # Import here: editors import slowly.
    from attnwarp.methods.pictures import resized

    return resized(picture, (camera.height, camera.width))


def blocks(cells: npt.NDArray[Any], size: Size) -> npt.NDArray[Any]:
    """(H, W, ...) of (h, w, ...) cells, each a block of pixels."""
    rows = np.arange(size[0]) * cells.shape[0] // size[0]
    columns = np.arange(size[1]) * cells.shape[1] // size[1]
    return np.asarray(cells[rows[:, None], columns])


def tinted(colors: Sequence[str], number: npt.NDArray[Any], image: Image) -> Image:
    """(H, W, 3) colours by number, over the darkened grey picture.

    Args:
        colors: "#rrggbb"; number -1 takes the last.
        number: (H, W) int.
        image: (H, W, 3) sRGB.
    """
    palette = np.stack([pictures.rgb(color) for color in colors])
    grey = image.mean(axis=2, keepdims=True)
    return (0.35 * grey + 0.65 * palette[number]).astype(np.float32)


def incidence_map(degrees: npt.NDArray[Any]) -> Image:
    """Angle of incidence at the source, 0 bright to 90 dark; grey where the surface turns away."""
    import matplotlib

    image = matplotlib.colormaps["viridis"](1 - np.nan_to_num(degrees, nan=90) / 90)[..., :3]
    faces = np.isfinite(degrees) & (degrees < 90)
    return np.where(faces[..., None], image, 0.6).astype(np.float32)


def disagreement_map(difference: npt.NDArray[Any]) -> Image:
    """Difference of edits, 0 dark to :data:`DISAGREEMENT` bright; grey where it is undefined."""
    import matplotlib

    scaled = np.clip(np.nan_to_num(difference) / DISAGREEMENT, 0, 1)
    image = matplotlib.colormaps["magma"](scaled)[..., :3]
    return np.where(np.isfinite(difference)[..., None], image, 0.6).astype(np.float32)


def _scale(colormap: str, texts: Sequence[str]) -> Legend:
    """Evenly spaced colours of a map."""
    import matplotlib
    from matplotlib.colors import to_hex

    colors = matplotlib.colormaps[colormap](np.linspace(0, 1, len(texts)))
    return [(text, to_hex(color)) for text, color in zip(texts, colors, strict=True)]
