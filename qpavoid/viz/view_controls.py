"""Controls, status and plots beside the scene of the live view."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from qpavoid.viz.style import COLOURS
from qpavoid.viz.view_link import Frame, PageSetup

_PLOTTED = 300
"""Frames that the plots show."""
_PLOT_PERIOD = 6
"""Frames between two updates of plots and status."""
_MAX_LINES = 8
"""Joints with a line of their own; of more, the fastest one alone is drawn."""


class Controls:
    """The panel of a page."""

    def __init__(self, server: Any, setup: PageSetup, post: Callable[..., None]) -> None:
        """Add the panel to a viser server; `post` sends an event to the loop."""
        self._gui, self._setup, self._post = server.gui, setup, post
        server.gui.configure_theme(dark_mode=False, control_layout="collapsible", show_share_button=False)
        server.gui.set_panel_label(setup.title)
        self._status = server.gui.add_markdown("waiting for the loop")
        self._resets: list[Callable[[], None]] = []
        if setup.controls:
            self._add_run_controls()
        self._bodies = server.gui.add_checkbox("collision bodies", False)
        self._plots = self._add_plots()
        self._times: deque[float] = deque(maxlen=_PLOTTED)
        self._distances: deque[list[float]] = deque(maxlen=_PLOTTED)
        self._speeds: deque[Any] = deque(maxlen=_PLOTTED)
        self._count = 0

    def on_body_toggle(self, show: Callable[[bool], None]) -> None:
        """Call something with whether the collision bodies shall be visible, whenever that changes."""

        @self._bodies.on_update  # type: ignore[untyped-decorator]
        async def _(_: Any) -> None:
            show(self._bodies.value)

    def on_reset(self, reset: Callable[[], None]) -> None:
        """Call something when the run is to begin anew."""
        self._resets.append(reset)

    def _add_run_controls(self) -> None:
        gui, values = self._gui, self._setup.controls
        gui_buttons = gui.add_button_group("time", ("play", "pause", "step", "reset"))

        @gui_buttons.on_click  # type: ignore[untyped-decorator]
        async def _(_: Any) -> None:
            if gui_buttons.value == "reset":
                self._clear()
                for reset in self._resets:
                    reset()
            self._post(type=gui_buttons.value)

        for label, key in (("play or pause", "space"), ("step", "arrowright")):
            command = gui.add_command(label, hotkey=key)

            @command.on_trigger  # type: ignore[untyped-decorator]
            async def _(_: Any, label: str = label) -> None:
                self._post(type="toggle" if label.startswith("play") else label)

        self._add("speed", gui.add_dropdown("speed", values["speeds"], initial_value="1x"))
        if "runs" in values:
            if len(values["runs"]) > 1:
                self._add("run", gui.add_dropdown("run", values["runs"], initial_value=values["runs"][0]))
            self._add("time", gui.add_slider("go to [s]", 0.0, values["duration"], values["dt"], 0.0))
        if "solvers" in values:
            self._add("solver", gui.add_dropdown("solver", values["solvers"], initial_value=values["solver"]))
            self._add("row", gui.add_dropdown("rows", values["rows"], initial_value=values["row"]))
            d1, d2 = (round(1e3 * values[name], 1) for name in ("d1", "d2"))
            self._add("d1", gui.add_number("d1 [mm]", d1, min=1.0, step=1.0))
            self._add("d2", gui.add_number("d2 [mm]", d2, min=2.0, step=1.0))
            gui.add_markdown("Drag obstacles with the mouse, targets by their arrows.")

    def _add(self, kind: str, control: Any) -> None:
        """Send each change of a control that a user makes."""

        @control.on_update  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            if event.client is not None:
                self._post(type=kind, value=control.value)

    def _add_plots(self) -> tuple[Any, Any]:
        from viser import uplot

        def line(label: str, stroke: str, width: float = 1.5) -> Any:
            return uplot.Series(label=label, stroke=stroke, width=width)

        def plot(title: str, lines: list[Any]) -> Any:
            data = tuple(np.zeros(2) for _ in range(len(lines) + 1))
            scales = {"x": uplot.Scale(time=False)}
            series = (uplot.Series(label="t [s]"), *lines)
            return self._gui.add_uplot(data, series, title=title, scales=scales, aspect=1.7)

        distance = [line("distance", "#C62F2F", 2.0), line("d1", "#7A4B9A"), line("d2", "#8A8A8A")]
        names = self._setup.joint_names if len(self._setup.joint_names) <= _MAX_LINES else ["fastest joint"]
        speeds = [line(name, COLOURS[i % len(COLOURS)]) for i, name in enumerate(names)]
        return plot("distance of the closest pair [mm]", distance), plot("joint speed / limit [%]", speeds)

    def show(self, frame: Frame) -> None:
        """Take a frame into the plots, and show status and plots now and then."""
        if self._times and frame.t < self._times[-1]:
            self._clear()
        self._count += 1
        if not self._times or frame.t > self._times[-1]:
            self._append(frame)
        if self._count % _PLOT_PERIOD == 0:
            if self._status.content != frame.text:
                self._status.content = frame.text
            if len(self._times) > 1:
                t = np.array(self._times)
                for plot, history in zip(self._plots, (self._distances, self._speeds), strict=True):
                    if not np.array_equal(plot.data[0], t):
                        plot.data = (t, *np.array(history, dtype=np.float64).T)

    def _append(self, frame: Frame) -> None:
        nearest = np.min(frame.witnesses[:, 0]) if len(frame.witnesses) else np.nan
        self._times.append(frame.t)
        self._distances.append([1e3 * float(distance) for distance in (nearest, *frame.levels)])
        percent = 100.0 * np.abs(frame.v) / self._setup.speed_limits
        self._speeds.append(percent if len(percent) <= _MAX_LINES else [percent.max()])

    def _clear(self) -> None:
        for history in (self._times, self._distances, self._speeds):
            history.clear()
