"""Commands that the actuators have been given and the robot has not followed yet."""

from __future__ import annotations

from math import ceil

import numpy as np

from qpavoid.problem import Array


class CommandsUnderWay:
    """The commands of the last `latency` seconds, in a ring laid out once.

    An actuator that follows every command `latency` later has all of them still to do. One that lags, as a position
    servo does, has done a part of the later ones and not all of those before; at constant velocity that is the same.
    """

    def __init__(self, nv: int, latency: float, dt: float) -> None:
        """Begin at rest; `latency` and the control period dt are in seconds."""
        count = ceil(latency / dt - 1e-9)
        self._commands, self._next = np.zeros((count, nv)), 0
        durations = np.full(count, dt)  # of the newest command first: the oldest one is followed in part
        durations[count - 1 :] = latency - (count - 1) * dt
        self._durations = np.tile(durations[::-1], 2)
        self._displacement = np.zeros(nv)

    @property
    def displacement(self) -> Array:
        """(nv,) displacement that the robot is still to make; the next call overwrites it [rad or m]."""
        count = len(self._commands)
        durations = self._durations[count - self._next : 2 * count - self._next]
        return np.dot(durations, self._commands, out=self._displacement)

    def add(self, v: Array, periods: int = 1) -> None:
        """Take v (nv,) as commanded, for some control periods."""
        for _ in range(min(periods, len(self._commands))):
            self._commands[self._next] = v
            self._next = (self._next + 1) % len(self._commands)

    def fill(self, v: Array) -> None:
        """Take v (nv,) as commanded all the time."""
        self._commands[:] = v
