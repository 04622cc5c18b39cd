"""Commands that the actuators have been given and the robot has not followed yet."""

from __future__ import annotations

from math import ceil

import numpy as np

from qpavoid.problem import Array

_MEMORY = 8.0
"""Age from which a command has been followed, in latencies [-]: all but 2e-6 of it."""


class CommandsUnderWay:
    """The commands of late, in a ring laid out once, and how much of each the robot has not followed yet.

    A critically damped servo follows a setpoint that moves at constant velocity by T = `latency` late. Of a step of it,
    the part (1 + s) exp(-s) is left after the time ½ s T; of a command v that was held from ½ s₁ T to ½ s₀ T ago, the
    displacement ½ T v [(2 + s₀) exp(-s₀) - (2 + s₁) exp(-s₁)], for s₀ < s₁: of the newest ones almost all. Drives that
    are late by a delay, or that lag exponentially, leave the same at constant velocity, else a little more or less.
    """

    def __init__(self, nv: int, latency: float, dt: float) -> None:
        """Begin at rest; `latency` and the control period dt are in seconds."""
        count = ceil(_MEMORY * latency / dt)
        self._commands, self._next = np.zeros((count, nv)), 0
        s = 2.0 * dt / (latency or 1.0) * np.arange(count)
        left = np.append(0.5 * latency * (2.0 + s) * np.exp(-s), 0.0)
        self._durations = np.tile((left[:-1] - left[1:])[::-1], 2)  # of the newest command last
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
