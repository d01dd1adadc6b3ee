"""The window: a 3D view with picture insets, keys, sliders, and picking of pixels and cells."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp_eval.inspect import draw, scene
from attnwarp_eval.inspect.cell import CellReport, cell_of, cell_report
from attnwarp_eval.inspect.gl import require_gl
from attnwarp_eval.inspect.pair import Image, Legend, Pair, Size
from attnwarp_eval.inspect.pixel import PixelReport, report
from attnwarp_eval.inspect.scene import State
from attnwarp_eval.inspect.subject import Subject

KEYS = {
    "n / p": "next, previous target view",
    "v": "next variant",
    "c": "next colouring",
    "l": "next feature grid, then pixels",
    "e": "next step of the edit",
    "d": "splats as discs, on and off",
    "g": "the whole true surface, on and off",
    "1 / 2": "look through the source, the target",
    "0": "look from outside",
    "f": "fly from the source to the target",
    "click": "a pixel or cell: rays and numbers",
    "?": "these keys, on and off",
    "q": "close",
}

SIZE = (1500, 900)

INSET_ROWS = 4

LARGEST_TITLE = 14
"""Height of an inset's title, in pixels."""

LETTER_WIDTH = 0.56
"""Width of a letter of a title in Arial, as a share of its height; 0.5 on average."""

FLIGHT = 40
"""Pictures of a flight from the source to the target."""

PICKING_TOLERANCE = 5e-4
"""Tolerance of a click on the surface, as a share of the window's diagonal: about a pixel."""

PIXELS = "pixels"
"""Name of the layer of image pixels."""


class Window:
    """A warp in 3D.

    Args:
        off_screen: whether to draw without a display.
        size: size of the window, in pixels.

    Attributes:
        picked: the report of the picked pixel or cell, or None.
        changed: callback after each change of the state.

    Raises:
        InputError: OpenGL is not available.
    """

    def __init__(
        self,
        subject: Subject,
        state: State,
        *,
        off_screen: bool = False,
        size: tuple[int, int] = SIZE,
    ) -> None:
        require_gl(display=not off_screen)
        self.subject = subject
        self.variants, self.targets = list(subject.variants), list(subject.targets)
        self.steps = list(subject.steps)
        self.state = state
        self.picked: PixelReport | CellReport | None = None
        self.help_shown = False
        self.changed: Callable[[], object] = lambda: None
        self._drawn: dict[str, tuple[Any, ...]] = {}
        self._insets: tuple[Any, ...] = ()
        self._large: dict[str, tuple[Any, Callable[[Any], Any]]] = {}
        self._lighter: dict[str, Any] = {}
        self._sliders: dict[str, tuple[Any, str, Sequence[Any]]] = {}
        # PyVista wraps its methods in a way that mypy cannot follow.
        self.plotter: Any = self._plotter(off_screen, size)
        self._samples: int = self.plotter.render_window.GetMultiSamples()
        # Showing the window or taking its picture renders it.
        self.plotter.suppress_rendering = True
        self._draw()
        self.look_from_outside()
        self.plotter.suppress_rendering = False

    @property
    def pair(self) -> Pair:
        """The displayed pair of views."""
        return self.subject.pair(self.state.variant, self.state.target)

    @property
    def layers(self) -> list[Size | None]:
        """The pixels (None) and the feature grids of the displayed pair."""
        return [None, *self.pair.layers]

    def show(self, **changes: Any) -> None:
        """Change some of the :class:`~attnwarp_eval.inspect.scene.State`.

        A picked pixel is picked again for another variant, and dropped for another view.
        """
        before = self.state
        self.state = replace(self.state, **changes)
        if self.state.layer not in self.layers:
            self.state = replace(self.state, layer=None)
        if self.picked is not None:
            if (self.state.target, self.state.layer) != (before.target, before.layer):
                self.picked = None
            elif self.state.variant != before.variant:
                self.picked = self._report(self.picked.column, self.picked.row)
        self._draw()

    def pick(self, column: int, row: int) -> PixelReport | CellReport:
        """Show a target pixel's rays and numbers; or those of its cell if a grid is shown."""
        if self.state.layer is not None:
            column, row = cell_of(self.pair, self.state.layer, column, row)
        self.picked = self._report(column, row)
        self._draw()
        return self.picked

    def _report(self, column: int, row: int) -> PixelReport | CellReport:
        if self.state.layer is None:
            return report(self.pair, column, row)
        return cell_report(self.pair, self.state.layer, column, row)

    # --- the camera

    def look_from_outside(self) -> None:
        """Look at the scene and both cameras from outside."""
        self._main()
        self.plotter.camera.view_angle = draw.VIEW_ANGLE
        width, height = self.plotter.renderer.GetSize()
        self.plotter.camera_position = draw.outside(
            self.subject, self.pair.cameras, width / max(height, 1)
        )
        self.plotter.reset_camera_clipping_range()
        self.plotter.render()

    def look_through(self, name: str) -> None:
        """Move the view to the source or a target."""
        camera = self.subject.views.camera(name)
        self._main()
        view = 2 * np.degrees(np.arctan(camera.height / 2 / camera.K[1, 1]))
        self.plotter.camera.view_angle = view
        self.look(camera.position, camera.rotation)

    def fly(self, show: Callable[[], object] = lambda: None, steps: int = FLIGHT) -> None:
        """Move the view from the source camera to the target; call ``show`` after each picture."""
        self.look_through(self.pair.cameras[0].name)
        for position, rotation in scene.fly(self.pair.cameras, self.subject.center, steps):
            self.look(position, rotation)
            show()

    def look(self, position: Any, rotation: Any) -> None:
        """Move the view to a camera's pose.

        Args:
            position: (3,) world.
            rotation: (3, 3) axes in rows: right, down, forward.
        """
        forward, down = rotation[2], rotation[1]
        distance = max(float(np.linalg.norm(self.subject.center - position)), 1e-6)
        self.plotter.camera_position = [position, position + distance * forward, -down]
        self.plotter.reset_camera_clipping_range()
        self.plotter.render()

    # --- out

    def screenshot(self, path: Path) -> None:
        """Write the window as a PNG."""
        from attnwarp.io.file import write_atomically
        from attnwarp.io.images import encode_png

        data = encode_png(np.ascontiguousarray(self.plotter.screenshot(return_img=True)[..., :3]))
        write_atomically(path, lambda stream: stream.write(data))

    def open(self) -> None:
        """Show the window until it is closed."""
        self._main()
        self._replace_keys()
        self._add_sliders()
        self.enable_picking()
        self.plotter.show()

    def close(self) -> None:
        """Free the window's graphics resources."""
        self.plotter.close()

    # --- keys, sliders, clicks

    def actions(self) -> dict[str, Callable[[], None]]:
        """Action of each key, by VTK's name of the key."""
        state = lambda: self.state  # noqa: E731
        return {
            "n": lambda: self.show(target=_next(self.targets, state().target)),
            "p": lambda: self.show(target=_next(self.targets, state().target, -1)),
            "v": lambda: self.show(variant=_next(self.variants, state().variant)),
            "c": lambda: self.show(coloring=_next(self.pair.colorings, state().coloring)),
            "l": lambda: self.show(layer=_next(self.layers, state().layer)),
            "e": lambda: self.show(step=_next(self.steps, state().step)),
            "d": lambda: self.show(splats=not state().splats),
            "g": lambda: self.show(surface=not state().surface),
            "question": self.toggle_help,
            "1": lambda: self.look_through(self.pair.cameras[0].name),
            "2": lambda: self.look_through(self.pair.target),
            "0": self.look_from_outside,
            "f": self.fly,
        }

    def _replace_keys(self) -> None:
        """Bind the keys of :data:`KEYS`, and no others.

        By default in PyVista and VTK, e closes the window and v turns the view.
        """
        interactor = self.plotter.iren
        interactor.clear_key_event_callbacks()
        interactor.style.AddObserver("CharEvent", lambda *_: None)
        for key, action in {**self.actions(), "q": interactor.terminate_app}.items():
            self.plotter.add_key_event(key, action)

    def toggle_help(self) -> None:
        """Show or hide the keys."""
        self.help_shown = not self.help_shown
        self._draw()

    def enable_picking(self) -> None:
        """Let a click pick the pixel under it."""
        self._main()
        self.plotter.enable_point_picking(
            callback=self._picked_point,
            # The point picker prefers a nearer surface next to the pointer.
            picker="cell",
            tolerance=PICKING_TOLERANCE,
            left_clicking=True,
            show_message=False,
            show_point=False,
            use_picker=True,
            pickable_window=False,
        )

    def _picked_point(self, point: Any, picker: Any) -> None:
        """Pick the target's pixel that shows a point, (3,) world, of the surface."""
        if picker.GetDataSet() is None:
            return
        camera = self.pair.cameras[1]
        column, row = np.floor(camera.project(np.asarray(point))[0]).astype(int).tolist()
        if 0 <= column < camera.width and 0 <= row < camera.height:
            self.pick(column, row)

    def _add_sliders(self) -> None:
        choices: dict[str, tuple[str, Sequence[Any]]] = {
            "view": ("target", self.targets),
            "variant": ("variant", self.variants),
            "layer": ("layer", self.layers),
            "step": ("step", self.steps),
        }
        choices = {name: choice for name, choice in choices.items() if len(choice[1]) > 1}
        width = 0.66 / len(choices) if choices else 0.0
        for number, (name, (field, values)) in enumerate(choices.items()):
            left = 0.3 + number * width
            slider = self.plotter.add_slider_widget(
                partial(self._slide, field, values),
                (0, len(values) - 1),
                value=values.index(getattr(self.state, field)),
                title=name,
                fmt="",
                pointa=(left, 0.07),
                pointb=(left + 0.85 * width, 0.07),
                title_height=0.018,
                style="modern",
                slider_width=0.025,
                tube_width=0.004,
                interaction_event="end",
            )
            # VTK's key i would hide it.
            slider.KeyPressActivationOff()
            self._sliders[name] = slider, field, values
        self._move_sliders()

    def _slide(self, field: str, values: Sequence[Any], number: float) -> None:
        chosen = values[round(number)]
        if chosen != getattr(self.state, field):
            self.show(**{field: chosen})

    def _move_sliders(self) -> None:
        for name, (slider, field, values) in self._sliders.items():
            value = getattr(self.state, field)
            shown = layer_name(value) if field == "layer" else value
            slider.GetRepresentation().SetValue(values.index(value))
            slider.GetRepresentation().SetTitleText(plain(f"{name}: {shown}"))

    # --- drawing

    def _plotter(self, off_screen: bool, size: tuple[int, int]) -> Any:
        import pyvista

        self._inset_columns = 1 if len(self.steps) == 1 else 2
        columns = self._inset_columns
        # PyVista's types name integers for both.
        layout: dict[str, Any] = {
            "groups": [(slice(None), columns)],
            "col_weights": [*[0.2 if columns == 1 else 0.13] * columns, 0.8],
        }
        plotter: Any = pyvista.Plotter(
            shape=(INSET_ROWS, columns + 1),
            **layout,
            off_screen=off_screen,
            window_size=list(size),
        )
        plotter.set_background("white", all_renderers=True)
        plotter.subplot(0, columns)
        plotter.renderer.AddObserver("StartEvent", self._clear_the_view)
        plotter.render_window.AddObserver("WindowResizeEvent", self._fit_insets)
        # Press, move, release. A click picks a pixel of the surface itself, which therefore is not
        # simplified until the mouse moves.
        for event, names in (("Start", {"discs"}), ("", {"discs", "seen"}), ("End", set[str]())):
            plotter.iren.style.AddObserver(
                f"{event}InteractionEvent", lambda *_, names=names: self._draw_lighter(names)
            )
        return plotter

    def _clear_the_view(self, renderer: Any, *_: Any) -> None:
        """Hide the picture of a camera at the view's position, which would cover everything."""
        eye = np.array(renderer.GetActiveCamera().GetPosition())
        near = 0.5 * scene.frustum_depth(self.subject, self.pair.cameras[0])
        for name, camera in zip(("source", "target"), self.pair.cameras, strict=True):
            if f"{name} picture" in self._drawn:
                far = bool(np.linalg.norm(eye - camera.position) > near)
                renderer.actors[f"{name} picture"].visibility = far

    def _main(self) -> None:
        """Turn to the 3D view; the insets are the other parts of the window."""
        self.plotter.subplot(0, self._inset_columns)

    @contextmanager
    def _one_render(self) -> Iterator[None]:
        """Render all changes made inside once, at the end; PyVista renders after every change."""
        before, self.plotter.suppress_rendering = self.plotter.suppress_rendering, True
        try:
            yield
        finally:
            self.plotter.suppress_rendering = before
        self.plotter.render()

    def _draw(self) -> None:
        if self.state.coloring not in self.pair.colorings:
            self.state = replace(self.state, coloring="mask")
        with self._one_render():
            self._draw_insets()
            self._main()
            self._draw_parts()
            self._draw_texts()
            self._move_sliders()
            self.plotter.reset_camera_clipping_range()
        self.changed()

    def _draw_insets(self) -> None:
        key = (self.state.variant, self.state.target, self.state.layer, self.state.step)
        if key == self._insets:
            return
        self._insets = key
        insets = self.pair.insets(self.state.layer, self.state.step or None)
        for index, (title, image) in enumerate(insets.items()):
            self.plotter.subplot(*divmod(index, self._inset_columns))
            self._draw_inset(title, image)
        for index in range(len(insets), INSET_ROWS * self._inset_columns):
            self.plotter.subplot(*divmod(index, self._inset_columns))
            for name in ("picture", "title"):
                # The plotter would remove it from all parts of the window.
                self.plotter.renderer.remove_actor(name)
        self._fit_insets()

    def _draw_inset(self, title: str, image: Image) -> None:
        height, width = image.shape[:2]
        plane = scene.picture_plane(
            np.array([[0, height, 0], [width, height, 0], [width, 0, 0], [0, 0, 0.0]])
        )
        self.plotter.add_mesh(
            plane, texture=draw.texture(image), lighting=False, name="picture", pickable=False
        )
        text = self.plotter.add_text(
            plain(title), position=(0.02, 0.97), viewport=True, name="title", color="black"
        )
        text.prop.justification_vertical = "top"
        self.plotter.view_xy()
        self.plotter.camera.parallel_projection = True

    def _fit_insets(self, *_: Any) -> None:
        """Titles of one size, as large as the longest allows, over whole pictures."""
        insets = [
            (renderer, renderer.actors["title"], renderer.actors["picture"].bounds)
            for renderer in self.plotter.renderers
            if {"title", "picture"} <= renderer.actors.keys()
        ]
        longest = max((len(text.input) for _, text, _ in insets), default=1)
        for renderer, text, bounds in insets:
            columns, rows = renderer.GetSize()
            letters = min(LARGEST_TITLE, columns / (LETTER_WIDTH * longest))
            text.prop.font_size = max(1, int(letters))
            # World units a pixel, so that the picture has room below its title.
            unit = max(
                bounds.x_max / (0.96 * columns), bounds.y_max / (0.98 * rows - 1.5 * letters)
            )
            x, y = bounds.x_max / 2, bounds.y_max / 2 + 0.75 * letters * unit
            renderer.camera.focal_point = (x, y, 0)
            renderer.camera.position = (x, y, renderer.camera.distance)
            renderer.camera.parallel_scale = unit * rows / 2

    def _draw_parts(self) -> None:
        parts = scene.parts(self.subject, self.pair, self.state, self.picked)
        for name in set(self._drawn) - {part.name for part in parts}:
            self.plotter.remove_actor(name)
            self._remove_lighter(name)
            del self._drawn[name]
        for part in parts:
            if self._drawn.get(part.name) != part.key:
                self._drawn[part.name] = part.key
                self._add(part)

    def _add(self, part: scene.Part) -> None:
        actor = draw.add_part(self.plotter, part)
        self._remove_lighter(part.name)
        if part.moving is not None and actor.mapper.dataset.n_cells > scene.MOVING:
            self._large[part.name] = (actor, part.moving)

    def _remove_lighter(self, name: str) -> None:
        self._large.pop(name, None)
        if name in self._lighter:
            self.plotter.remove_actor(self._lighter.pop(name))

    def _make_lighter(self, name: str) -> Any:
        """Simplified version of a large mesh, made when the view first moves."""
        actor, make = self._large[name]
        self._main()
        before, self.plotter.suppress_rendering = self.plotter.suppress_rendering, True
        try:
            return draw.add_lighter(self.plotter, name, make(actor.mapper.dataset))
        finally:
            self.plotter.suppress_rendering = before

    def _draw_lighter(self, names: Collection[str]) -> None:
        """While the mouse moves, simplify these meshes and turn off smooth edges; neither if empty.

        Software spends more on smooth edges than on 100,000 discs.
        """
        moving = bool(names)
        for name, (actor, _) in self._large.items():
            if name in names and name not in self._lighter:
                self._lighter[name] = self._make_lighter(name)
            actor.visibility = name not in names
        for name, lighter in self._lighter.items():
            lighter.visibility = name in names
        window = self.plotter.render_window
        if moving:
            # The graphics' abilities are known after the first drawing.
            self._samples = window.GetMultiSamples() or self._samples
        window.SetMultiSamples(0 if moving else self._samples)

    def _draw_texts(self) -> None:
        pair, state = self.pair, self.state
        title = scene.title(self.subject, pair, state)
        numbers = [] if self.picked is None else ["", *self.picked.lines()]
        self._text("title", "\n".join([title, *numbers]), "upper_left")
        keys = "\n".join(f"{key:>6}  {what}" for key, what in KEYS.items())
        self._text("help", keys if self.help_shown else "? for keys", "lower_left")
        self._draw_legend(pair.legend(state.coloring))

    def _draw_legend(self, legend: Legend) -> None:
        import pyvista

        # A missing legend cannot be removed.
        if self.plotter.renderer.legend is not None:
            self.plotter.remove_legend()
        if not legend:
            return
        labels = [[plain(text), "black"] for text, _ in legend]
        actor = self.plotter.add_legend(
            labels, bcolor="white", background_opacity=0.8, face="rectangle"
        )
        for number, (_, color) in enumerate(legend):
            # An entry has one colour for its text and its symbol, unless the symbol has its own.
            symbol = pyvista.PolyData(actor.GetEntrySymbol(number))
            rgb = np.array(pyvista.Color(color).int_rgb, dtype=np.uint8)
            symbol.point_data["colors"] = np.tile(rgb, (symbol.n_points, 1))
            symbol.set_active_scalars("colors")
            actor.SetEntrySymbol(number, symbol)
        longest = max(len(text) for text, _ in labels)
        width, height = 0.011 * longest + 0.05, 0.026 * len(labels)
        actor.SetPosition(0.99 - width, 0.99 - height)
        actor.SetPosition2(width, height)

    def _text(self, name: str, text: str, position: str) -> None:
        actor = self.plotter.add_text(
            plain(text, 4000), position=position, font_size=8, name=name, color="black",
            font="courier",
        )  # fmt: skip
        actor.prop.background_color = "white"
        actor.prop.background_opacity = 0.7 if text else 0.0


def plain(text: str, most: int = 120) -> str:
    """Text that VTK draws literally: no control characters, no formulas, limited length."""
    text = "".join(c if c == "\n" or c.isprintable() else "?" for c in text)
    text = text if len(text) <= most else f"{text[: most - 3]}..."
    return text.replace("$", "\\$")


def _next(names: Sequence[Any], current: Any, by: int = 1) -> Any:
    return names[(names.index(current) + by) % len(names)]


def layer_name(layer: Size | None) -> str:
    """ "pixels", or the size of a feature grid in words."""
    return PIXELS if layer is None else f"{layer[1]} x {layer[0]}"
