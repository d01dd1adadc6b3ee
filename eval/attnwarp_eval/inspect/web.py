"""The window in a browser, served on this machine through trame."""

from __future__ import annotations

import asyncio
import secrets
import sys
from collections.abc import Callable
from typing import Any

from attnwarp.errors import InputError, optional_imports
from attnwarp_eval.inspect.window import Window, layer_name, plain

LOCAL = "127.0.0.1"

LEFT = 10.0
"""Seconds from the last browser's leaving to the server's end; a reload takes less."""


def check_web() -> None:
    """Require trame before any computation.

    Raises:
        MissingExtraError: trame is not installed.
    """
    with optional_imports():
        import trame.app
        import trame.widgets.vtk
        import trame.widgets.vuetify3  # noqa: F401


def serve(
    window: Window,
    *,
    host: str = LOCAL,
    port: int = 0,
    announce: Callable[[str], object] = print,
) -> None:
    """Serve a window, drawn off screen, until the last browser has left or it is interrupted.

    The address holds a secret: other users of the machine and other pages of the browser cannot
    connect without it. ``announce`` is called with it, and port 0 takes a free one.

    Raises:
        InputError: the address cannot be used.
    """
    secret = secrets.token_urlsafe(16)
    try:
        asyncio.run(_serve(_Page(window, announce), host, port, secret))
    except OSError as error:
        raise InputError(
            f"--host {host} --port {port}: {error.strerror or error}; choose another, or leave"
            " --port out"
        ) from None


def server_arguments(secret: str) -> list[str]:
    """The secret as an argument of trame; one word, since a secret may begin with a dash."""
    return [f"--authKey={secret}"]


async def _serve(page: _Page, host: str, port: int, secret: str) -> None:
    page.url = lambda bound: f"http://{host}:{bound}/index.html?secret={secret}"
    # trame parses the command line, which clashes with this command's options.
    arguments, sys.argv = sys.argv, ["attnwarp-eval", *server_arguments(secret)]
    try:
        task = page.server.start(
            host=host,
            port=port,
            timeout=0,
            open_browser=False,
            show_connection_info=False,
            disable_logging=True,
            exec_mode="coroutine",
            thread=True,  # leaves Ctrl-C to this process
        )
    finally:
        sys.argv = arguments
    await task


class _Page:
    """The page's controls, each of which changes the window's state."""

    def __init__(self, window: Window, announce: Callable[[str], object]) -> None:
        from trame.app import get_server

        self.window, self.announce = window, announce
        self.clients, self.joined = 0, False
        self.url: Callable[[int], str] = str
        self.server: Any = get_server("attnwarp-inspect", client_type="vue3")
        state, controller = self.server.state, self.server.controller
        self._describe()
        self._build()
        state.change("target", "variant", "coloring", "layer", "step", "splats", "surface")(
            self._changed
        )
        controller.on_server_ready.add(self._ready)
        controller.on_client_connected.add(self._joined)
        self.server.add_protocol_to_configure(self._watch_clients)
        window.enable_picking()
        window.changed = self._drawn

    def _describe(self) -> None:
        """Write the window's state into the controls."""
        window, state = self.window, self.server.state
        current = window.state
        state.targets = [plain(name) for name in window.targets]
        state.variants = [
            {"title": plain(name), "value": k} for k, name in enumerate(window.variants)
        ]
        state.colorings = list(window.pair.colorings)
        state.layers = [layer_name(layer) for layer in window.layers]
        state.steps = list(window.steps)
        state.target = window.targets.index(current.target)
        state.variant = window.variants.index(current.variant)
        state.coloring = current.coloring
        state.layer = window.layers.index(current.layer)
        state.step = window.steps.index(current.step)
        state.splats, state.surface = current.splats, current.surface
        state.numbers = "" if window.picked is None else "\n".join(window.picked.lines())

    def _changed(self, **_: Any) -> None:
        """Apply the controls' state."""
        window, state = self.window, self.server.state
        wanted = {
            "target": window.targets[int(state.target)],
            "variant": window.variants[int(state.variant)],
            "coloring": state.coloring,
            "layer": window.layers[min(int(state.layer), len(window.layers) - 1)],
            "step": window.steps[int(state.step)],
            "splats": bool(state.splats),
            "surface": bool(state.surface),
        }
        changes = {
            name: value for name, value in wanted.items() if value != getattr(window.state, name)
        }
        if changes and state.coloring in window.pair.colorings:
            window.show(**changes)

    def _drawn(self) -> None:
        self._describe()
        self.server.state.flush()
        self.server.controller.view_update()

    def _look(self, action: Callable[[], object]) -> Callable[[], None]:
        def look() -> None:
            action()
            self.server.controller.view_update()

        return look

    async def _fly(self) -> None:
        from attnwarp_eval.inspect import scene

        window = self.window
        for position, rotation in scene.fly(window.pair.cameras, window.subject.center, 24):
            window.look(position, rotation)
            self.server.controller.view_update()
            # The picture is sent during this wait.
            await asyncio.sleep(0.05)

    def _ready(self, **_: Any) -> None:
        self.announce(self.url(self.server.port))

    def _joined(self, **_: Any) -> None:
        """A browser with the secret has opened the page."""
        self.joined = True

    def _watch_clients(self, root: Any) -> None:
        """Count the browsers, and end when the last has left."""
        from wslink.websocket import LinkProtocol

        page = self

        class Clients(LinkProtocol):
            def onConnect(self, request: Any, client_id: Any) -> None:  # noqa: N802
                page.clients += 1

            def onClose(self, client_id: Any) -> None:  # noqa: N802
                page.clients -= 1
                if page.joined and page.clients == 0:
                    asyncio.get_running_loop().call_later(LEFT, page._end)

        root.registerLinkProtocol(Clients())

    def _end(self) -> None:
        if self.clients == 0:
            self._ending = asyncio.ensure_future(self.server.stop())

    def _build(self) -> None:
        from trame.ui.vuetify3 import VAppLayout
        from trame.widgets import html, vtk, vuetify3

        window = self.window
        self.server.state.trame__title = "attnwarp-eval inspect"
        compact = {"density": "compact", "hide_details": True}
        with VAppLayout(self.server):
            with (
                vuetify3.VNavigationDrawer(permanent=True, width=330),
                vuetify3.VContainer(classes="pa-3"),
            ):
                html.Div("view: {{ targets[target] }}", classes="text-caption")
                _slider(vuetify3, "target", "targets")
                vuetify3.VSelect(
                    label="variant", v_model=("variant",), items=("variants",), **compact
                )
                vuetify3.VSelect(
                    label="colours",
                    v_model=("coloring",),
                    items=("colorings",),
                    classes="mt-3",
                    **compact,
                )
                html.Div("grid: {{ layers[layer] }}", classes="text-caption mt-3")
                _slider(vuetify3, "layer", "layers")
                if len(window.steps) > 1:
                    html.Div("step: {{ steps[step] }}", classes="text-caption mt-3")
                    _slider(vuetify3, "step", "steps")
                vuetify3.VCheckbox(label="splats as discs", v_model=("splats",), **compact)
                if window.pair.world is not None:
                    vuetify3.VCheckbox(
                        label="the whole true surface", v_model=("surface",), **compact
                    )
                looks = {
                    "source": lambda: window.look_through(window.pair.cameras[0].name),
                    "target": lambda: window.look_through(window.pair.target),
                    "outside": window.look_from_outside,
                }
                for name, look in looks.items():
                    vuetify3.VBtn(name, click=self._look(look), size="small", classes="ma-1")
                vuetify3.VBtn("fly", click=self._fly, size="small", classes="ma-1")
                html.Div(
                    "click on the surface: a pixel or cell, its rays and its numbers",
                    classes="text-caption mt-2",
                )
                html.Pre("{{ numbers }}", style="font-size: 11px; overflow-x: auto;")
            with (
                vuetify3.VMain(),
                vuetify3.VContainer(fluid=True, classes="pa-0", style="height: 100vh;"),
            ):
                view = vtk.VtkRemoteView(
                    window.plotter.render_window, ref="view", interactive_ratio=1
                )
                self.server.controller.view_update = view.update


def _slider(vuetify3: Any, name: str, values: str) -> None:
    vuetify3.VSlider(
        v_model=(name,),
        min=0,
        max=(f"{values}.length - 1",),
        step=1,
        show_ticks="always",
        density="compact",
        hide_details=True,
        __properties=[("show_ticks", "show-ticks")],
        classes=f"slider-{name}",
    )
