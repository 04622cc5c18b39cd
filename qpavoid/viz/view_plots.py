"""Scrolling plots beside the scene of the live view: distances and joint speeds."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from qpavoid.problem import Array
from qpavoid.viz.style import COLOURS, OBSTACLES
from qpavoid.viz.view_ghosts import COLOURS as GHOSTS
from qpavoid.viz.view_link import BACKUP, Frame, PageSetup

PLOTTED = 300
"""Frames that the plots show."""
_MAX_LINES = 8
"""Joints, and obstacles, with a line of their own; of more joints, the fastest one alone is drawn."""
_DISTANCES = "distances up to d2 [mm]"
_GONE = -2
"""Slot of an obstacle that has gone."""
_ITSELF, _D1, _D2, _LIMIT = "#333333", "#7A4B9A", "#8A8A8A", "#C62F2F"


class Plots:
    """The plots of a page."""

    def __init__(self, gui: Any, setup: PageSetup) -> None:
        """Add the plots to the panel."""
        from viser import uplot

        self._gui, self._uplot, self._setup, self._obstacles = gui, uplot, setup, list[tuple[int, str]]()
        self._has_others = False  # whether another run was shown yet
        self._has_many = len(setup.joint_names) > _MAX_LINES
        names = ["fastest joint"] if self._has_many else setup.joint_names
        speeds = [(name, COLOURS[i % len(COLOURS)]) for i, name in enumerate(names)] + [("limit", _LIMIT)]
        self._times: deque[float] = deque(maxlen=PLOTTED)
        self._histories: tuple[deque[Any], deque[Any]] = deque(maxlen=PLOTTED), deque(maxlen=PLOTTED)
        self._plots = [
            self._plot(_DISTANCES, self._distance_lines()),
            self._plot("joint speed / limit [%]", speeds),
        ]

    def _plot(self, title: str, lines: list[tuple[str, str]], order: float | None = None) -> Any:
        data = (np.array([0.0, 1.0]), *(np.zeros(2) for _ in lines))
        series = [self._uplot.Series(label=label, stroke=stroke, width=1.8) for label, stroke in lines]
        scales = {"x": self._uplot.Scale(time=False)}
        return self._gui.add_uplot(
            data, (self._uplot.Series(label="t [s]"), *series), title=title, scales=scales, aspect=1.7, order=order
        )

    def _distance_lines(self) -> list[tuple[str, str]]:
        others = [(name, _hex(GHOSTS[(1 + i) % len(GHOSTS)])) for i, name in enumerate(self._others)]
        obstacles = [
            (name, _hex(255.0 * np.array(OBSTACLES[slot % len(OBSTACLES)]))) for slot, name in self._obstacles
        ]  # fmt: skip
        return [("d1", _D1), ("d2", _D2), ("itself", _ITSELF), *others, *obstacles]

    @property
    def _others(self) -> list[str]:
        """Names of the other runs, once there are some."""
        return self._setup.others if self._has_others else []

    def name_obstacles(self, names: list[tuple[int, str]]) -> None:
        """Draw a line for each obstacle, of a slot and a name: of the first ones that there were.

        Those that have gone keep their lines: viser never forgets a plot that was removed, so that there is a new one
        only for a name that is new.
        """
        slots = {name: slot for slot, name in names}
        lines = [(slots.pop(name, _GONE), name) for _, name in self._obstacles]
        new = [(slot, name) for name, slot in slots.items()][: _MAX_LINES - len(lines)]
        self._obstacles = [*lines, *new]
        if new:
            self._renew_distances()

    def _renew_distances(self) -> None:
        """Plot other lines from now on."""
        self.clear()
        order = self._plots[0].order
        self._plots[0].remove()  # the browser does not take other lines into a plot that it has
        self._plots[0] = self._plot(_DISTANCES, self._distance_lines(), order)

    def clear(self) -> None:
        """Begin anew."""
        for history in (self._times, *self._histories):
            history.clear()

    def take(self, frame: Frame) -> None:
        """Take a frame into the plots, unless it is of a moment that they show already."""
        if self._times and frame.t < self._times[0]:
            self.clear()
        if self._times and frame.t <= self._times[-1]:
            return
        if not self._has_others and (frame.ghosts[:, 0] > BACKUP).any():
            self._has_others = True
            self._renew_distances()
        witnesses, percent = frame.witnesses, 100.0 * np.abs(frame.v) / self._setup.speed_limits
        beyond = frame.levels[1]  # of what is farther away than d2, which is not computed
        others = np.full(len(self._others), beyond)
        for kind, distance in frame.ghosts[:, :2]:
            if kind > BACKUP:
                others[int(kind) - 1] = min(distance, beyond)
        columns = [_nearest(witnesses, i, beyond) for i in (-1, *(i for i, _ in self._obstacles))]
        columns[1:1] = others.tolist()
        self._times.append(frame.t)
        self._histories[0].append(1e3 * np.array([*frame.levels, *columns]))
        self._histories[1].append([*([percent.max()] if self._has_many else percent), 100.0])

    def draw(self) -> None:
        """Show what was taken."""
        if len(self._times) < 2:
            return
        t = np.array(self._times)
        for plot, history in zip(self._plots, self._histories, strict=True):
            if not np.array_equal(plot.data[0], t):
                plot.data = (t, *np.array(history, dtype=np.float64).T)


def _nearest(witnesses: Array, obstacle: int, beyond: float) -> float:
    return float(witnesses[witnesses[:, 7] == obstacle, 0].min(initial=beyond))


def _hex(colour: Any) -> str:
    return "#" + "".join(f"{int(part):02X}" for part in colour)
