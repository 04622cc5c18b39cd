"""Settings of each library; read by its adapter and printed in the report.

Nothing here needs the library.
"""

from __future__ import annotations

from typing import Any

DAMPING = 0.05
"""λ of the damped inverse of every library [-]: all of them need one, and its square is what they are given."""

_SHARED = {
    "targets": "one period ahead along the task's own law",
    "damping": f"{DAMPING} squared",
}

PINK: dict[str, Any] = {
    **_SHARED,
    "solver": "daqp",
    "cost": 50.0,
    "n_collision_pairs": 20,
    "gain": 20.0,
    "safe_displacement_gain": 1.0,
    "d_min": "d1",
    "limits": "position and velocity, and acceleration where the robot has one",
}
"""`cost` multiplies the root of a task's weight; it and the barrier's gains are those of Pink's example
kukas_self_collision. Fewer pairs than `n_collision_pairs`: all of them; more: the nearest ones."""

MINK: dict[str, Any] = {
    **_SHARED,
    "solver": "daqp",
    "minimum_distance_from_collisions": "d1",
    "collision_detection_distance": "d2",
}
"""Settings of mink; other parameters of its limits are at its defaults: gains 0.85 for pairs and 0.95 for joints."""

PLACO: dict[str, Any] = {
    **_SHARED,
    "self_collisions_margin": "d1",
    "self_collisions_trigger": "d2",
    "priority": "hard",
}
"""Settings of placo: soft tasks, hard joint and velocity limits."""

PLACO_PYTHON = "QPAVOID_PLACO_PYTHON"
"""Environment variable that names the Python interpreter that has placo; this one if not set."""
