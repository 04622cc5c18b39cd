"""Where obstacles will be: on their trajectories, or at mean twists that turn as of late; and how far that may be off.

A *state* of an obstacle is a row of 18, see `qpavoid.kernels.obstacles`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.obstacles import Pieces, sample_pieces
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.turns import follow_arc
from qpavoid.problem import Array, IntArray


class Prediction(NamedTuple):
    """What is known of o obstacles at one time, as far as the future follows from it."""

    pieces: Pieces
    """Trajectories of those that follow one."""
    which: IntArray
    """(k,) numbers of those that may have another state than at time 0."""
    states: Array
    """(o, 18) of all obstacles at that time."""
    margin: Array
    """(o,) to be taken off the distances to each [m]."""
    external: IntArray
    """(e,) numbers of those that a program gives."""
    twists: Array
    """(o, 6) mean twists of these [m/s, rad/s]."""
    turns: Array
    """(o, 3) rates at which their linear velocities turn [rad/s]."""
    t: float
    """That time [s]."""


@compiled
def predict(x: Prediction, t: float, states: Array) -> None:
    """Write the states of all obstacles at t, but for trajectories that are no `Pieces`.

    Args:
        x: what is known.
        t: time [s].
        states: out (o, 18).
    """
    states[:] = x.states
    if t == x.t:
        return
    sample_pieces(x.pieces, t, states)
    for i in x.external:
        states[i, :12], states[i, 12:] = x.states[i, :12], x.twists[i]
        follow_arc(states[i], x.turns[i], t - x.t)


@compiled
def prediction_error_bound(now: Prediction, earlier: Prediction, span: float, radii: Array) -> float:
    """Bound how far any point of an external obstacle is from an earlier prediction, now and for some time [m].

    Positions and rotations that are off by δp and δR, twists by δv and δω, and turns by δΩ, leave a point that is r
    from the origin no farther off than |δp| + t |δv| + ½ t² |δΩ| |v| + r (‖δR‖ + t |δω|) after t: rotations by tΩ
    differ by no more than t |δΩ|. The smaller |v| of the two counts.

    Args:
        now: what is known now.
        earlier: what the prediction was made of.
        span: for how long it counts [s].
        radii: distance from each obstacle's origin to its farthest point (o,) [m]; half-spaces have no end.

    Returns:
        The bound; infinite where the two are not of the same obstacles.
    """
    if len(now.external) != len(earlier.external):
        return np.inf
    worst, expected = 0.0, np.empty(18)
    for k in range(len(now.external)):
        i = now.external[k]
        if earlier.external[k] != i:
            return np.inf
        expected[:12], expected[12:] = earlier.states[i, :12], earlier.twists[i]
        follow_arc(expected, earlier.turns[i], now.t - earlier.t)
        position, rotation, linear, angular, turn, speed, speed_before = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(9):
            rotation += (now.states[i, c] - expected[c]) ** 2
        for c in range(3):
            position += (now.states[i, 9 + c] - expected[9 + c]) ** 2
            linear += (now.twists[i, c] - expected[12 + c]) ** 2
            angular += (now.twists[i, 3 + c] - expected[15 + c]) ** 2
            turn += (now.turns[i, c] - earlier.turns[i, c]) ** 2
            speed += now.twists[i, c] ** 2
            speed_before += earlier.twists[i, c] ** 2
        bound, turned = np.sqrt(position) + span * np.sqrt(linear), np.sqrt(rotation) + span * np.sqrt(angular)
        bound += 0.5 * span * span * np.sqrt(turn * min(speed, speed_before))
        worst = max(worst, bound + (radii[i] * turned if turned > 0.0 else 0.0))
    return worst
