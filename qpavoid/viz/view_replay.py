"""Plays saved runs on a page of the live view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from qpavoid.errors import ConfigError
from qpavoid.run.log import Log
from qpavoid.viz.log_frames import LogFrames
from qpavoid.viz.view import View, page_setup, run_page
from qpavoid.viz.view_clock import SPEEDS, PlayClock
from qpavoid.viz.view_link import Frame

_PLANNED_POINTS = 300


class Replay:
    """Saved runs of one robot among the same obstacles: one is shown in full, the others over it, translucent."""

    def __init__(
        self, logs: Sequence[Log], *, port: int = 8080, host: str = "127.0.0.1", quality: str = "high"
    ) -> None:
        """Build what the runs show and start the page.

        Args:
            logs: the runs.
            port: see `View`.
            host: see `View`.
            quality: see `View`.

        Raises:
            ConfigError: logs without steps or of different scenes, or what `LogFrames` and `View` need is missing.
        """
        first = logs[0]
        for log in logs:
            if not len(log.t):
                raise ConfigError(f"{_label(log)}: a run without a step")
            if log.meta["robot"] != first.meta["robot"] or log.meta["obstacles"] != first.meta["obstacles"]:
                raise ConfigError(
                    f"{_label(log)}: another robot or other obstacles than {_label(first)}; show it alone"
                )
        labels = [_label(log) for log in logs]
        self._labels = [name if labels.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(labels)]
        self._runs = [LogFrames(log) for log in logs]
        longest = max(logs, key=lambda log: len(log.t))
        planned = list(np.swapaxes(longest.target[:: -(-len(longest.t) // _PLANNED_POINTS)], 0, 1))
        title = first.meta["title"] or labels[0]
        setup = page_setup(self._runs[0].robot, first.meta["obstacles"], [], title, first.q[0], planned)
        dt = float(np.median(np.diff(first.t))) if len(first.t) > 1 else 0.01
        duration = max(float(log.t[-1]) for log in logs)
        setup.controls = {"speeds": SPEEDS, "duration": duration, "dt": dt, "runs": tuple(self._labels)}
        setup.others = self._labels if len(logs) > 1 else []
        setup.port, setup.host, setup.quality = port, host, quality
        self.clock, self.run_shown, self.step = PlayClock(dt), 0, 0
        """Number of the run and step that are shown."""
        self.view = View.of_setup(setup)

    @property
    def frames(self) -> LogFrames:
        """Return the run that is shown."""
        return self._runs[self.run_shown]

    def run(self, is_done: Callable[[], bool] = lambda: False) -> None:
        """Play until `is_done`, the page fails, or the keyboard interrupts; it begins at the first browser."""
        run_page(self.view, self.clock, self._apply, self._advance, is_done)

    def _advance(self) -> None:
        if self.clock.wait():
            self.step = (self.step + 1) % len(self.frames)
        if self.view.is_due():
            self.view.show(self._frame())

    def _frame(self) -> Frame:
        frame = self.frames.frame(self.step)
        ghosts = [
            (1.0 + number, run.log.min_distance[step], *run.log.q[step])
            for number, run in enumerate(self._runs)
            if number != self.run_shown
            for step in (min(int(np.searchsorted(run.log.t, frame.t - 1e-9)), len(run) - 1),)
        ]
        return frame._replace(ghosts=np.array(ghosts)) if ghosts else frame

    def _apply(self, event: dict[str, Any]) -> None:
        self.clock.apply(event)
        match event["type"]:
            case "reset":
                self.step = 0
            case "closest":
                self.clock.is_playing, self.step = False, self.frames.closest_step
            case "time":
                self.clock.is_playing = False
                self.step = min(int(np.searchsorted(self.frames.log.t, event["value"] - 1e-9)), len(self.frames) - 1)
            case "run" if event["value"] in self._labels:
                self.run_shown = self._labels.index(event["value"])
                self.step = min(self.step, len(self.frames) - 1)


def _label(log: Log) -> str:
    return f"{log.meta['scenario']} {log.meta['solver']}"
