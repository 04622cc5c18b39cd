"""Distances of the pairs that are nearest to each body, and poses of all bodies, in many states."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.near_pairs import least_distance
from qpavoid.kernels.packing import compiled, released
from qpavoid.kernels.structures import call, call_for_code, call_for_placing
from qpavoid.problem import Array, IntArray, Mask


class RecordingCalls(NamedTuple):
    """Addresses of kernels, see `kernels.structures`."""

    place_obstacles: Any
    update_kinematics: Any
    place_bodies: Any
    candidate_pairs: Any
    measure_pairs: Any


class NearestPairs(NamedTuple):
    """Pairs that were nearest to each of b bodies in the state before: those that likely are again."""

    bodies: IntArray
    """(m, 2) bodies that each pair counts for; -1 for none."""
    pair: IntArray
    """(b,) nearest pair of each body; -1 of one that is not known."""
    distance: Array
    """(b,) scratch: its distance [m]."""
    due: IntArray
    """(m,) scratch, the first entries: pairs that are measured in this state."""
    is_due: Mask
    """(m,) scratch: pairs that are due because they were nearest; none between two states."""


@released
def measure_states(
    calls: RecordingCalls, kinematics: Any, x: Any, nearest: NearestPairs, q: Array, states: Array, numbers: IntArray,
    margin: Array, joints: IntArray, distance: Array, posed: Array, first: int, last: int,
) -> int:  # fmt: skip
    """Write the distances of the pairs that may be nearest to a body in some states, and the poses of all bodies.

    Args:
        calls: kernels.
        kinematics: memory of them, see `KinematicsArrays`.
        x: memory of the distances, see `DistanceArrays`.
        nearest: in and out.
        q: configurations (n, nq).
        states: of the obstacles (n, o, 18).
        numbers: of the obstacles to place (k,).
        margin: taken off the distances to each (o,) [m].
        joints: that move the b bodies of the robot (b,).
        distance: out (n, m + 1); those of pairs that are not measured stay as they are [m].
        posed: out (n, b, 12): poses of these joints.
        first: number of the first state.
        last: number after that of the last state.

    Returns:
        Number of a state for which the distances of some pairs have to be computed by other means: of what is written
        for it, nothing counts. `last` where there is none.
    """
    for n in range(first, last):
        call_for_placing(calls.place_obstacles, (x, numbers, states[n], margin))
        call(calls.update_kinematics, (kinematics, q[n]))
        call(calls.place_bodies, (x, kinematics.joint_poses))
        candidates = call_for_code(calls.candidate_pairs, (x,))
        known = nearest_before(x, nearest)
        meeting = call_for_code(calls.measure_pairs, (x, nearest.due[:known]))
        note_nearest(x, nearest, 0, known, distance[n])
        count = pairs_that_may_be_nearer(x, nearest, x.near[:candidates], known)
        meeting += call_for_code(calls.measure_pairs, (x, nearest.due[known:count]))
        note_nearest(x, nearest, known, count, distance[n])
        if meeting > 0:
            return n
        for b in range(len(joints)):
            for c in range(12):
                posed[n, b, c] = kinematics.joint_poses[joints[b], c]
    return last


@compiled
def nearest_before(x: Any, s: NearestPairs) -> int:
    """Write the nearest pairs of the state before as those that are due; return how many there are."""
    count = 0
    for b in range(len(s.pair)):
        k = s.pair[b]
        s.distance[b] = np.inf
        if k >= 0 and x.enabled[k] and not x.ignored[k] and not s.is_due[k]:
            s.due[count], s.is_due[k] = k, True
            count += 1
    return count


@compiled
def pairs_that_may_be_nearer(x: Any, s: NearestPairs, candidates: IntArray, known: int) -> int:
    """Add pairs that may be nearer to a body than its nearest so far to the `known` ones that are due; count all."""
    count = known
    for k in candidates:
        if x.ignored[k] or s.is_due[k]:
            continue
        one, two, bound = s.bodies[k, 0], s.bodies[k, 1], least_distance(x, k)
        is_farther = (one < 0 or bound > s.distance[one]) and (two < 0 or bound > s.distance[two])
        if not is_farther or (one < 0 and two < 0):
            s.due[count] = k
            count += 1
    for k in s.due[:known]:
        s.is_due[k] = False
    return count


@compiled
def note_nearest(x: Any, s: NearestPairs, first: int, last: int, distance: Array) -> None:
    """Write the distances (m + 1,) of pairs that were due, and take those that are nearer than the nearest so far."""
    for k in s.due[first:last]:
        d = distance[k] = x.results[k, 0]
        for side in range(2):
            b = s.bodies[k, side]
            if b >= 0 and d <= s.distance[b]:
                s.distance[b], s.pair[b] = d, k
