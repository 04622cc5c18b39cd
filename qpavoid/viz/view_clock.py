"""Play, pause, step and speed of what runs at the pace of the wall clock."""

from __future__ import annotations

import time
from typing import Any

SPEEDS = ("0.1x", "0.25x", "0.5x", "1x", "2x", "4x")
"""Speeds that a page offers, in seconds of the run per second."""
_IDLE = 1.0 / 30.0
"""Sleep between two looks at the page while nothing moves [s]."""
_MOST_LATE = 0.25
"""Lateness from which the clock starts anew, rather than catch up [s]."""


class PlayClock:
    """Says when the next step is due."""

    def __init__(self, dt: float) -> None:
        """Begin paused; steps are dt apart [s]."""
        self._dt, self._speed, self._steps, self._due = dt, 1.0, 0, time.perf_counter()
        self.is_playing = False

    def apply(self, event: dict[str, Any]) -> None:
        """Take an event of the page, if it concerns the clock."""
        match event["type"]:
            case "play":
                self.play()
            case "pause":
                self.is_playing = False
            case "toggle":
                self.is_playing = not self.is_playing
                self._due = time.perf_counter()
            case "step":
                self.is_playing, self._steps = False, self._steps + 1
            case "speed" if event["value"] in SPEEDS:
                self._speed = float(event["value"][:-1])

    def play(self) -> None:
        """Let time go on."""
        self.is_playing, self._due = True, time.perf_counter()

    def wait(self) -> bool:
        """Sleep until the next step is due, or for a moment; return whether a step is due."""
        if self._steps:
            self._steps -= 1
            return True
        if not self.is_playing:
            time.sleep(_IDLE)
            return False
        now = time.perf_counter()
        if now > self._due + _MOST_LATE:
            self._due = now
        if self._due - now > _IDLE:
            time.sleep(_IDLE)
            return False
        time.sleep(max(0.0, self._due - now))
        self._due += self._dt / self._speed
        return True
