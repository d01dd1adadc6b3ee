"""The window: a 3D view with picture insets, keys, a slider, and picking of pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from attnwarp.errors import InputError
from attnwarp_eval.inspect import scene
from attnwarp_eval.inspect.pair import COLORINGS, Pair
from attnwarp_eval.inspect.pixel import PixelReport, report

if TYPE_CHECKING:
    import pyvista

KEYS = {
    "n / p": "next, previous target view",
    "v": "next variant",
    "c": "next colouring of the surface",
    "d": "splats as discs, on and off",
    "g": "the whole true surface, on and off",
    "1 / 2": "look through the source, the target",
    "0": "look from outside",
    "click": "a pixel: its rays and its numbers",
    "?": "these keys, on and off",
    "q": "close",
}

INSETS = ("source", "target", "source, warped", "mask against truth")
MAIN = 4
"""Index of the 3D view; the insets come before it."""

SIZE = (1500, 900)


class Window:
    """A warp in 3D.

    Args:
        make_pair: the pair of a (variant, target); called on first use of each.
        variants, targets: their names, in order.
        variant, target: those to begin with; the first ones if left out.
        coloring: one of :data:`COLORINGS`.
        splats: whether splats are drawn at first.
        off_screen: draw without a display.
        size: of the window, in pixels.

    Raises:
        InputError: no OpenGL can be had.
    """

    def __init__(
        self,
        make_pair: Callable[[str, str], Pair],
        variants: Sequence[str],
        targets: Sequence[str],
        *,
        variant: str | None = None,
        target: str | None = None,
        coloring: str = "mask",
        splats: bool = False,
        off_screen: bool = False,
        size: tuple[int, int] = SIZE,
    ) -> None:
        self._make_pair = make_pair
        self._pairs: dict[tuple[str, str], Pair] = {}
        self.variants, self.targets = list(variants), list(targets)
        self.variant, self.target = variant or self.variants[0], target or self.targets[0]
        self.coloring = coloring
        self.picked: PixelReport | None = None
        self.splats_shown, self.surface_shown, self.help_shown = splats, False, False
        # PyVista wraps its methods in a way that mypy cannot follow.
        self.plotter: Any = _plotter(off_screen, size)
        self._draw()
        self.look_from_outside()

    @property
    def pair(self) -> Pair:
        """The pair of views on show."""
        key = self.variant, self.target
        if key not in self._pairs:
            self._pairs[key] = self._make_pair(*key)
        return self._pairs[key]

    def show_target(self, name: str) -> None:
        """Go to a target view."""
        self.target, self.picked = name, None
        self._draw()

    def show_variant(self, name: str) -> None:
        """Go to a variant."""
        self.variant = name
        self._draw()

    def show_coloring(self, name: str) -> None:
        """Colour the surface by one of :data:`COLORINGS`."""
        self.coloring = name
        with self._one_render():
            self._draw_surface()

    def pick(self, column: int, row: int) -> PixelReport:
        """Show a target pixel's rays and numbers."""
        self.picked = report(self.pair, column, row)
        with self._one_render():
            self._draw_picked()
        return self.picked

    def look_from_outside(self) -> None:
        """A view of the scene and of both cameras."""
        world, target = self.pair.world, self.pair.world.targets[self.target]
        center = np.asarray(world.scene.center, dtype=np.float64)
        eyes = np.stack([world.source.position, target.position]) - center
        away = (
            eyes.mean(0)
            if np.linalg.norm(eyes.mean(0)) > 0.3 * np.linalg.norm(eyes[0])
            else (np.cross(eyes[0], [0, 0, 1.0]))
        )
        reach = np.linalg.norm(eyes, axis=1).max()
        direction = away / np.linalg.norm(away) + [0, 0, 0.5]
        self.plotter.subplot(MAIN)
        self.plotter.camera_position = [
            center + 2.1 * reach * direction / np.linalg.norm(direction), center, (0, 0, 1),
        ]  # fmt: skip

    def look_through(self, name: str) -> None:
        """Take the place of the source ("source") or of a target."""
        camera = self.pair.world.camera(name)
        self.plotter.subplot(MAIN)
        forward, down = camera.rotation[2], camera.rotation[1]
        self.plotter.camera_position = [camera.position, camera.position + forward, -down]
        view = 2 * np.degrees(np.arctan(camera.height / 2 / camera.K[1, 1]))
        self.plotter.camera.view_angle = view

    def screenshot(self, path: Path) -> None:
        """Write the window as a picture."""
        self.plotter.screenshot(str(path))

    def export(self, path: Path) -> None:
        """Write what is on show as .html (to look at), .gltf or .vtp (the coloured surface).

        Raises:
            InputError: another ending.
        """
        if path.suffix == ".vtp":
            scene.seen_surface(self.pair.truth.hits, self.pair.colors(self.coloring)).save(path)
        elif path.suffix == ".gltf":
            self._alone().export_gltf(str(path))
        elif path.suffix == ".html":
            try:
                self._alone().export_html(str(path))
            except ImportError:
                raise InputError(
                    f"{path}: a page needs trame; install it with: pip install 'attnwarp[inspect]'"
                ) from None
        else:
            raise InputError(
                f"{path}: got {path.suffix or 'no ending'}, expected .html, .gltf or .vtp"
            )

    def open(self) -> None:
        """Show the window until it is closed."""
        plotter = self.plotter
        plotter.subplot(MAIN)
        for key, action in self._actions().items():
            plotter.add_key_event(key, action)
        if len(self.targets) > 1:
            plotter.add_slider_widget(
                self._slide,
                (0, len(self.targets) - 1),
                value=self.targets.index(self.target),
                title="target view",
                fmt="%.0f",
                pointa=(0.62, 0.08),
                pointb=(0.95, 0.08),
            )
        plotter.enable_point_picking(
            callback=self._picked_point, left_clicking=True, show_message=False, use_picker=True
        )
        plotter.show()

    def _actions(self) -> dict[str, Callable[[], None]]:
        def step(names: Sequence[str], current: str, by: int) -> str:
            return names[(names.index(current) + by) % len(names)]

        return {
            "n": lambda: self.show_target(step(self.targets, self.target, 1)),
            "p": lambda: self.show_target(step(self.targets, self.target, -1)),
            "v": lambda: self.show_variant(step(self.variants, self.variant, 1)),
            "c": lambda: self.show_coloring(step(COLORINGS, self.coloring, 1)),
            "d": lambda: self._toggle("splats_shown"),
            "g": lambda: self._toggle("surface_shown"),
            "question": lambda: self._toggle("help_shown"),
            "1": lambda: self.look_through(self.pair.world.source.name),
            "2": lambda: self.look_through(self.target),
            "0": self.look_from_outside,
        }

    def _toggle(self, name: str) -> None:
        setattr(self, name, not getattr(self, name))
        self._draw()

    def _slide(self, value: float) -> None:
        name = self.targets[round(value)]
        if name != self.target:
            self.show_target(name)

    def _picked_point(self, point: Any, picker: Any) -> None:
        mesh, index = picker.GetDataSet(), picker.GetPointId()
        if mesh is None or index < 0 or not mesh.GetPointData().HasArray("pixel"):
            return
        pixel = int(mesh.GetPointData().GetArray("pixel").GetValue(index))
        self.pick(pixel % self.pair.truth.label.shape[1], pixel // self.pair.truth.label.shape[1])

    @contextmanager
    def _one_render(self) -> Iterator[None]:
        """PyVista renders after every change; what changes inside is rendered once, at the end."""
        self.plotter.suppress_rendering = True
        try:
            yield
        finally:
            self.plotter.suppress_rendering = False
        self.plotter.render()

    def _draw(self) -> None:
        with self._one_render():
            self._draw_insets()
            self.plotter.subplot(MAIN)
            self._draw_cameras()
            self._draw_surface()
            self._optional(
                "discs", self.splats_shown and self.pair.model is not None, self._add_discs
            )
            self._optional("whole surface", self.surface_shown, self._add_whole_surface)
            self._draw_help()
            self._draw_picked()

    def _draw_insets(self) -> None:
        plotter = self.plotter
        for index, (title, image) in enumerate(self.pair.insets().items()):
            plotter.subplot(index)
            height, width = image.shape[:2]
            plane = scene.picture_plane(
                np.array([[0, height, 0], [width, height, 0], [width, 0, 0], [0, 0, 0.0]])
            )
            plotter.add_mesh(plane, texture=_texture(image), lighting=False, name="picture")
            plotter.add_text(title, font_size=8, name="title", color="black")
            plotter.view_xy()
            plotter.camera.parallel_projection = True
            plotter.camera.parallel_scale = height / 1.8

    def _draw_help(self) -> None:
        help_text = "\n".join(f"{key:>6}  {what}" for key, what in KEYS.items())
        self.plotter.add_text(
            help_text if self.help_shown else "? for keys",
            position="lower_left",
            font_size=8,
            name="help",
            color="black",
            font="courier",
        )

    def _draw_cameras(self) -> None:
        world = self.pair.world
        reach = 0.25 * float(np.linalg.norm(world.source.position - world.scene.center))
        cameras = {"source": world.source, "target": world.targets[self.target]}
        colors = {"source": "#1f4e9c", "target": "#b35a00"}
        for (name, camera), image in zip(cameras.items(), self.pair.images, strict=True):
            edges, corners = scene.frustum(camera, reach)
            self.plotter.add_mesh(edges, color=colors[name], line_width=3, name=f"{name} frustum")
            self.plotter.add_mesh(
                scene.picture_plane(corners),
                texture=_texture(image),
                lighting=False,
                opacity=0.9,
                name=f"{name} picture",
            )

    def _draw_surface(self) -> None:
        self.plotter.subplot(MAIN)
        mesh = scene.seen_surface(self.pair.truth.hits, self.pair.colors(self.coloring))
        self.plotter.add_mesh(mesh, scalars="colors", rgb=True, lighting=False, name="seen")
        self.plotter.add_text(
            f"{self.pair.world.scene.name}, {self.variant}, source -> {self.target};"
            f" coloured by {self.coloring}",
            font_size=10,
            name="title",
            color="black",
        )

    def _add_discs(self) -> None:
        assert self.pair.model is not None
        mesh = scene.discs(self.pair.model)
        self.plotter.add_mesh(mesh, scalars="colors", rgb=True, name="discs")

    def _add_whole_surface(self) -> None:
        mesh = scene.true_surface(self.pair.world.geometry)
        self.plotter.add_mesh(mesh, color="#c8c8c8", opacity=0.35, name="whole surface")

    def _optional(self, name: str, wanted: bool, add: Callable[[], None]) -> None:
        if wanted:
            add()
        else:
            self.plotter.remove_actor(name)

    def _draw_picked(self) -> None:
        self.plotter.subplot(MAIN)
        names = ("target ray", "to the source", "point", "blocker")
        for name in names:
            self.plotter.remove_actor(name)
        self.plotter.remove_actor("numbers")
        if self.picked is None:
            return
        colors = dict(zip(names, ("#b35a00", "#1f4e9c", "#000000", "#e31a1c"), strict=True))
        for name, mesh in scene.rays(self.pair, self.picked).items():
            self.plotter.add_mesh(
                mesh,
                color=colors[name],
                line_width=3,
                point_size=14,
                render_points_as_spheres=True,
                name=name,
            )
        self.plotter.add_text(
            "\n".join(self.picked.lines()),
            position="upper_right",
            font_size=7,
            name="numbers",
            color="black",
            font="courier",
        )

    def _alone(self) -> Any:
        """The 3D view without insets: what exporters take."""
        import pyvista

        plotter: Any = pyvista.Plotter(off_screen=True)
        pair = self.pair
        mesh = scene.seen_surface(pair.truth.hits, pair.colors(self.coloring))
        plotter.add_mesh(mesh, scalars="colors", rgb=True, lighting=False)
        for camera in (pair.world.source, pair.world.targets[self.target]):
            reach = 0.25 * float(
                np.linalg.norm(pair.world.source.position - pair.world.scene.center)
            )
            plotter.add_mesh(scene.frustum(camera, reach)[0], line_width=3)
        return plotter


def _plotter(off_screen: bool, size: tuple[int, int]) -> Any:
    import os

    import pyvista

    if not off_screen and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "inspect: this machine has no display; draw a picture instead with --screenshot FILE,"
            " or write a page with --export FILE.html"
        )
    plotter: Any = pyvista.Plotter(
        shape="4|1", off_screen=off_screen, window_size=list(size), splitting_position=0.2
    )
    plotter.set_background("white")
    return plotter


def _texture(image: np.ndarray) -> pyvista.Texture:
    import pyvista

    return pyvista.Texture(np.ascontiguousarray(scene.as_bytes(image)))
