"""Distances of all pairs, and poses of all bodies, in the states of many control steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.packing import released
from qpavoid.kernels.structures import call, call_for_placing, call_for_three_counts
from qpavoid.problem import Array, IntArray


class RecordingCalls(NamedTuple):
    """Addresses of kernels, see `kernels.structures`."""

    place_obstacles: Any
    update_kinematics: Any
    place_bodies: Any
    near_pairs: Any


@released
def measure_states(
    calls: RecordingCalls, kinematics: Any, x: Any, q: Array, states: Array, numbers: IntArray, margin: Array,
    joints: IntArray, distance: Array, posed: Array, first: int, last: int,
) -> int:  # fmt: skip
    """Write distances and poses in some states.

    Args:
        calls: kernels.
        kinematics: memory of them, see `KinematicsArrays`.
        x: memory of the distances, see `DistanceArrays`.
        q: configurations (n, nq).
        states: of the obstacles (n, o, 18).
        numbers: of the obstacles to place (k,).
        margin: taken off the distances to each (o,) [m].
        joints: that move the b bodies of the robot (b,).
        distance: out (n, m + 1); those of pairs that are not near stay as they are [m].
        posed: out (n, b, 12): poses of these joints.
        first: number of the first state.
        last: number after that of the last state.

    Returns:
        Number of a state for which the distances of some pairs have to be computed by other means: nothing has been
        written for it and those after it. `last` where there is none.
    """
    for n in range(first, last):
        call_for_placing(calls.place_obstacles, (x, numbers, states[n], margin))
        call(calls.update_kinematics, (kinematics, q[n]))
        call(calls.place_bodies, (x, kinematics.joint_poses))
        _, rows, meeting = call_for_three_counts(calls.near_pairs, (x, np.inf))
        if meeting > 0:
            return n
        for i in range(rows):
            distance[n, x.rows[i]] = x.results[x.rows[i], 0]
        for b in range(len(joints)):
            for c in range(12):
                posed[n, b, c] = kinematics.joint_poses[joints[b], c]
    return last
