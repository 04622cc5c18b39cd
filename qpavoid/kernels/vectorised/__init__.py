"""Array work of a tick in numpy: no Python loop over pairs, few calls, each on small arrays.

`qpavoid.kernels.compiled` has the same functions as loops for numba; both pass the same tests.
"""

from qpavoid.kernels.vectorised.ahead import bends, closest_call, joint_speeds, tracking_clear
from qpavoid.kernels.vectorised.bounds import velocity_bounds
from qpavoid.kernels.vectorised.culling import candidates, in_one_alone
from qpavoid.kernels.vectorised.flights import comes_too_near, least_apart, look_around, ramp
from qpavoid.kernels.vectorised.frames import damped_solution, frame_rows, projection_cost
from qpavoid.kernels.vectorised.motions import check_states, pack_pieces, place_obstacles, sample_pieces, take_in
from qpavoid.kernels.vectorised.packing import pack
from qpavoid.kernels.vectorised.pairs import distance_rows, row_bounds
from qpavoid.kernels.vectorised.stops import stop_velocity, stop_way
from qpavoid.kernels.vectorised.tick import assemble, shortfall, tracking_shortfall
from qpavoid.kernels.vectorised.voxels import choose, within_reach

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
