"""Array work of a tick, as loops that numba compiles at their first use and keeps on disk (`kernels.cache`)."""

from qpavoid.kernels.active_set import farthest, minimize, project, project_soft
from qpavoid.kernels.ahead import TOLERANCE, bends, closest_call, joint_speeds, tracking_clear
from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.cache import first_use
from qpavoid.kernels.culling import candidates, in_one_alone
from qpavoid.kernels.flights import ROUND_OFF, comes_too_near, least_apart, look_around, ramp
from qpavoid.kernels.frames import damped_solution, frame_rows, projection_cost
from qpavoid.kernels.layout import RowLayout
from qpavoid.kernels.motions import Pieces, Placed, check_states, place_obstacles, sample_pieces, take_in
from qpavoid.kernels.packing import pack
from qpavoid.kernels.pairs import distance_rows, row_bounds
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.kernels.stopping import speed_to_stop
from qpavoid.kernels.stops import easing_stop, stop_velocity, stop_way
from qpavoid.kernels.tick import assemble, shortfall, tracking_shortfall
from qpavoid.kernels.voxels import choose, within_reach

__all__ = [
    "ROUND_OFF",
    "TOLERANCE",
    "Pieces",
    "Placed",
    "RowLayout",
    "assemble",
    "bends",
    "candidates",
    "check_states",
    "choose",
    "closest_call",
    "comes_too_near",
    "damped_solution",
    "distance_rows",
    "easing_stop",
    "farthest",
    "first_use",
    "frame_rows",
    "in_one_alone",
    "joint_speeds",
    "least_apart",
    "look_around",
    "minimize",
    "pack",
    "place_obstacles",
    "project",
    "project_soft",
    "projection_cost",
    "ramp",
    "rotation_vector",
    "row_bounds",
    "sample_pieces",
    "shortfall",
    "speed_to_stop",
    "stop_velocity",
    "stop_way",
    "take_in",
    "tracking_clear",
    "tracking_shortfall",
    "velocity_bounds",
    "within_reach",
]
