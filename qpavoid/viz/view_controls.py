"""Controls and status beside the scene of the live view."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from qpavoid.viz.view_ghosts import COLOURS
from qpavoid.viz.view_link import BACKUP, Frame, PageSetup
from qpavoid.viz.view_plots import Plots
from qpavoid.viz.view_status import hint_html, legend_html, text_html

_PERIOD = 6
"""Frames between two updates of plots and status."""


class Controls:
    """The panel of a page."""

    def __init__(self, server: Any, setup: PageSetup, post: Callable[..., None]) -> None:
        """Add the panel to a viser server; `post` sends an event to the loop."""
        self._gui, self._setup, self._post = server.gui, setup, post
        server.gui.configure_theme(dark_mode=False, control_layout="collapsible", show_share_button=False)
        server.gui.set_panel_label(setup.title)
        self._status = server.gui.add_html(text_html("waiting for the loop"))
        if "hint" in setup.controls:
            server.gui.add_html(hint_html(setup.controls["hint"]))
        self._resets: list[Callable[[], None]] = []
        self._time: Any = None
        self._removable: Any = None
        values = setup.controls
        if "speeds" in values:
            self._add_time(values)
        if "solvers" in values:
            self._add_laws(values)
        if "joints" in values:
            self._add_joints(values["joints"])
        self._legend = server.gui.add_html("") if setup.others else None
        self._plots = Plots(server.gui, setup) if "joints" not in values else None
        if "shapes" in values:
            self._add_obstacles(values["shapes"])
        if "weights" in values:
            self._add_weights(values["weights"])
        self._bodies = server.gui.add_checkbox("collision bodies", bool(values.get("shows bodies")))
        for title, text in values.get("texts", ()):
            with server.gui.add_folder(title, expand_by_default=False):
                server.gui.add_html(text)
        self._count = 0

    def wait(self, text: str) -> None:
        """Say what is waited for, in plain text."""
        self._status.content = text_html(text)

    def on_body_toggle(self, show: Callable[[bool], None]) -> None:
        """Call something with whether the collision bodies shall be visible, whenever that changes."""

        @self._bodies.on_update  # type: ignore[untyped-decorator]
        async def _(_: Any) -> None:
            show(self._bodies.value)

    def on_reset(self, reset: Callable[[], None]) -> None:
        """Call something when the run is to begin anew."""
        self._resets.append(reset)

    def name_obstacles(self, names: list[tuple[int, str]]) -> None:
        """Offer these obstacles, of their slots, for removal, and plot their distances."""
        if self._removable is not None:
            self._removable.options = tuple(name for _, name in names) or ("none",)
        if self._plots is not None:
            self._plots.name_obstacles(names)

    def _add_time(self, values: dict[str, Any]) -> None:
        gui = self._gui
        words = ("play", "pause", "step", "reset") + (("closest",) if "runs" in values else ())
        buttons = gui.add_button_group("time", words)

        @buttons.on_click  # type: ignore[untyped-decorator]
        async def _(_: Any) -> None:
            self._press(buttons.value)

        for label, key in (("play or pause", "space"), ("step", "arrowright")):
            command = gui.add_command(label, hotkey=key)

            @command.on_trigger  # type: ignore[untyped-decorator]
            async def _(_: Any, label: str = label) -> None:
                self._press("toggle" if label.startswith("play") else label)

        self._add("speed", gui.add_dropdown("speed", values["speeds"], initial_value="1x"))
        if "runs" in values:
            if len(values["runs"]) > 1:
                self._add("run", gui.add_dropdown("run", values["runs"], initial_value=values["runs"][0]))
            self._time = gui.add_slider("time [s]", 0.0, values["duration"], values["dt"], 0.0)
            self._add("time", self._time)
        else:
            self._back = gui.add_slider("look back [s]", 0.0, values["look back"], 0.1, 0.0)
            self._add("back", self._back)

    def _press(self, word: str) -> None:
        """Do what a button of the time does."""
        if word == "reset":
            if self._plots is not None:
                self._plots.clear()
            for reset in self._resets:
                reset()
        if "runs" not in self._setup.controls and word != "pause":
            self._back.value = 0.0
        self._post(type=word)

    def _add_laws(self, values: dict[str, Any]) -> None:
        gui = self._gui
        with gui.add_folder("control"):
            self._add("solver", gui.add_dropdown("solver", values["solvers"], initial_value=values["solver"]))
            self._add("beside", gui.add_dropdown("beside", values["besides"], initial_value=values["beside"]))
            self._add("row", gui.add_dropdown("rows", values["rows"], initial_value=values["row"]))
            d1, d2 = (round(1e3 * values[name], 1) for name in ("d1", "d2"))
            self._add("d1", gui.add_number("d1 [mm]", d1, min=1.0, step=1.0))
            self._add("d2", gui.add_number("d2 [mm]", d2, min=2.0, step=1.0))

    def _add_weights(self, weights: list[tuple[str, float]]) -> None:
        with self._gui.add_folder("weights", expand_by_default=False):
            for name, weight in weights:
                self._add("weight", self._gui.add_number(name, weight, min=1e-9, step=1e-6), name=name)

    def _add_joints(self, joints: list[tuple[str, float, float, float]]) -> None:
        for index, (name, lower, upper, value) in enumerate(joints):
            slider = self._gui.add_slider(name, lower, upper, 1e-3 * (upper - lower), value)
            self._add("joint", slider, index=index)

    def _add_obstacles(self, shapes: tuple[str, ...]) -> None:
        gui = self._gui
        with gui.add_folder("obstacles"):
            shape = gui.add_dropdown("shape", shapes, initial_value=shapes[0])
            size = gui.add_slider("size [mm]", 20.0, 400.0, 10.0, 120.0)
            add = gui.add_button("add")
            self._removable = gui.add_dropdown("name", ("none",), initial_value="none")
            remove = gui.add_button("remove")

        @add.on_click  # type: ignore[untyped-decorator]
        async def _(_: Any) -> None:
            self._post(type="add", shape=shape.value, size=size.value)

        @remove.on_click  # type: ignore[untyped-decorator]
        async def _(_: Any) -> None:
            if self._removable.value != "none":
                self._post(type="remove", name=self._removable.value)

    def _add(self, kind: str, control: Any, **more: Any) -> None:
        """Send each change of a control that a user makes."""

        @control.on_update  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            if event.client is not None:
                self._post(type=kind, value=control.value, **more)

    def show(self, frame: Frame) -> None:
        """Take a frame into the plots, and show status and plots now and then."""
        if self._plots is not None:
            self._plots.take(frame)
        self._count += 1
        if self._count % _PERIOD:
            return
        if self._legend is not None:
            count = int(frame.ghosts[:, 0].max(initial=BACKUP))
            legend = legend_html(self._setup.others[:count], COLOURS[1 : 1 + count])
            if self._legend.content != legend:
                self._legend.content = legend
        if self._status.content != frame.text:
            self._status.content = frame.text
        if self._time is not None and abs(self._time.value - frame.t) > 1e-9:
            self._time.value = min(max(frame.t, 0.0), self._setup.controls["duration"])
        if self._plots is not None:
            self._plots.draw()
