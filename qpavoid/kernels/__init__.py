"""Array work of a tick: compiled by numba where it is installed, else in numpy; one interface, one set of tests.

`QPAVOID_NUMBA=0` in the environment switches the compiled version off.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import TYPE_CHECKING

ACCELERATED = os.environ.get("QPAVOID_NUMBA", "1") != "0" and find_spec("numba") is not None
"""Whether the compiled version is used."""

if TYPE_CHECKING or not ACCELERATED:
    from qpavoid.kernels import vectorised as _chosen
else:
    from qpavoid.kernels import compiled as _chosen

assemble = _chosen.assemble
candidates = _chosen.candidates
choose = _chosen.choose
closest_call = _chosen.closest_call
damped_solution = _chosen.damped_solution
distance_rows = _chosen.distance_rows
frame_rows = _chosen.frame_rows
in_one_alone = _chosen.in_one_alone
joint_speeds = _chosen.joint_speeds
pack = _chosen.pack
pack_pieces = _chosen.pack_pieces
place_obstacles = _chosen.place_obstacles
projection_cost = _chosen.projection_cost
row_bounds = _chosen.row_bounds
sample_pieces = _chosen.sample_pieces
shortfall = _chosen.shortfall
stop_velocity = _chosen.stop_velocity
stop_way = _chosen.stop_way
take_in = _chosen.take_in
tracking_clear = _chosen.tracking_clear
tracking_shortfall = _chosen.tracking_shortfall
velocity_bounds = _chosen.velocity_bounds
within_reach = _chosen.within_reach

__all__ = [
    "ACCELERATED",
    "assemble",
    "candidates",
    "choose",
    "closest_call",
    "damped_solution",
    "distance_rows",
    "frame_rows",
    "in_one_alone",
    "joint_speeds",
    "pack",
    "pack_pieces",
    "place_obstacles",
    "projection_cost",
    "row_bounds",
    "sample_pieces",
    "shortfall",
    "stop_velocity",
    "stop_way",
    "take_in",
    "tracking_clear",
    "tracking_shortfall",
    "velocity_bounds",
    "within_reach",
]
