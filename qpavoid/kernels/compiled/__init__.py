"""The functions of `qpavoid.kernels.vectorised` as loops that numba compiles; documented there.

Compiled code is cached on disk, so that only the first run after an installation waits for the compiler.
"""

from qpavoid.kernels.compiled.ahead import bends, closest_call, joint_speeds, tracking_clear
from qpavoid.kernels.compiled.bounds import velocity_bounds
from qpavoid.kernels.compiled.culling import candidates, in_one_alone
from qpavoid.kernels.compiled.flights import comes_too_near, least_apart, look_around, ramp
from qpavoid.kernels.compiled.frames import damped_solution, frame_rows, projection_cost
from qpavoid.kernels.compiled.motions import check_states, pack_pieces, place_obstacles, sample_pieces, take_in
from qpavoid.kernels.compiled.packing import pack
from qpavoid.kernels.compiled.pairs import distance_rows, row_bounds
from qpavoid.kernels.compiled.stops import stop_velocity, stop_way
from qpavoid.kernels.compiled.tick import assemble, shortfall, tracking_shortfall
from qpavoid.kernels.compiled.voxels import choose, within_reach

__all__ = [
    "assemble",
    "bends",
    "candidates",
    "check_states",
    "choose",
    "closest_call",
    "comes_too_near",
    "damped_solution",
    "distance_rows",
    "frame_rows",
    "in_one_alone",
    "joint_speeds",
    "least_apart",
    "look_around",
    "pack",
    "pack_pieces",
    "place_obstacles",
    "projection_cost",
    "ramp",
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
