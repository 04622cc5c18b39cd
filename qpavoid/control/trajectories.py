"""Where many bodies are, as rows of one array: the trajectories of all, sampled together.

A row is the *state* of a body: rotation by columns, position, linear and angular velocity, all in world axes (18,).
Every trajectory of `model.trajectory` is cut into pieces on which the state is a weighted sum of constant ones, with
weights that follow from the time alone (`kernels.Pieces`): rest, a straight line (p0, Δp), the shortest turn by
Rodrigues' formula (R0 + [a]² R0, [a] R0, -[a]² R0), a circle (c, w, u). A trajectory of another class
is sampled alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.kernels import Pieces
from qpavoid.model.trajectory import END_TOLERANCE, Motion, Orbit, Polyline, Sample, Still
from qpavoid.problem import Array

STATE = 18
"""Numbers in a state."""


def as_samples(states: Array) -> list[Sample]:
    """Views of each row of the states (k, 18)."""
    return [Sample(row[9:12], row[:9].reshape(3, 3).T, row[12:15], row[15:]) for row in states]


def put(view: Sample, sample: Sample) -> None:
    """Writes a sample into one of the views of `as_samples`."""
    view[0][:], view[1][:], view[2][:], view[3][:] = sample[:4]


def extrapolate(states: Array, t: float | Array) -> None:
    """Bring bodies to where they are some time later at constant twists about their origins, in place.

    Args:
        states: (k, 18).
        t: that time, one for all or (k,) [s].
    """
    kernels.extrapolate_states(states, np.full(len(states), t, dtype=np.float64))


class TrajectoryBatch:
    """The trajectories of some bodies."""

    def __init__(self, motions: Mapping[int, Motion]) -> None:
        """Lays the memory out.

        Args:
            motions: trajectory of each body, by the row of the states that it has.
        """
        cuts = {body: _cut(motion) for body, motion in motions.items()}
        known = {body: cut for body, cut in cuts.items() if cut is not None}
        self.others = {body: motion for body, motion in motions.items() if body not in known}
        """Those that have to be sampled one by one."""
        self._pieces = _joined(known) if known else None

    def sample(self, t: float, states: Array) -> None:
        """Brings the states (o, 18) of all bodies but the `others` to a finite time t [s]; see `Motion.sample`."""
        if self._pieces is not None:
            kernels.sample_pieces(self._pieces, t, END_TOLERANCE, states)


class _Cut(NamedTuple):
    """One trajectory in pieces; see `Pieces`."""

    starts: Array
    clock: Array
    terms: Array


def _joined(cuts: Mapping[int, _Cut]) -> Pieces:
    counts = [len(cut.starts) for cut in cuts.values()]
    return Pieces(
        bodies=np.array(list(cuts), dtype=np.intp),
        first=np.concatenate(([0], np.cumsum(counts))).astype(np.intp),
        starts=np.concatenate([cut.starts for cut in cuts.values()]),
        clock=np.concatenate([cut.clock for cut in cuts.values()]),
        terms=np.concatenate([cut.terms for cut in cuts.values()]),
    )


def _cut(motion: Motion) -> _Cut | None:
    """None where the class is one of somebody else's, even if it is derived from one of ours."""
    if type(motion) is Still:
        return _cut_still(motion)
    if type(motion) is Polyline:
        return _cut_polyline(motion)
    if type(motion) is Orbit:
        return _cut_orbit(motion)
    return None


def _cut_still(motion: Still) -> _Cut:
    return _resting([motion.pose])


def _cut_polyline(motion: Polyline) -> _Cut:
    pieces = motion.pieces
    cut = _resting([motion.first, *(piece.start for piece in pieces), motion.last])
    cut.starts[1:] = motion.times
    if pieces:
        terms = cut.terms[1:-1]
        cut.clock[1:-1] = [(piece.time, piece.duration, piece.angle, motion.smooth) for piece in pieces]
        terms[:, 1, 9:12] = terms[:, 4, 12:15] = [piece.displacement for piece in pieces]
        turns = np.array([piece.angle > 0.0 for piece in pieces])[:, None]
        once, twice = (turns * [piece.turned[i].T.ravel() for piece in pieces] for i in (0, 1))
        terms[:, 0, :9] += twice
        terms[:, 2, :9], terms[:, 3, :9] = once, -twice
        terms[:, 4, 15:] = [piece.angle * piece.axis for piece in pieces]
    return cut


def _cut_orbit(motion: Orbit) -> _Cut:
    after = [motion.sample(motion.end)] if motion.end < inf else []
    cut = _resting([motion.sample(-1.0), motion.center, *after])
    cut.starts[1:] = [0.0, motion.end][: 1 + len(after)]
    cut.clock[1] = 0.0, 1.0, motion.omega, 0.0
    circle = cut.terms[1]
    circle[2, 9:12] = circle[6, 12:15] = motion.w
    circle[3, 9:12] = motion.u
    circle[5, 12:15] = -motion.u
    return cut


def _resting(samples: Sequence[Sample]) -> _Cut:
    """Pieces of rest."""
    count = len(samples)
    cut = _Cut(np.full(count, -inf), np.zeros((count, 4)), np.zeros((count, 7, STATE)))
    cut.clock[:, 1] = inf
    for view, sample in zip(as_samples(cut.terms[:, 0]), samples, strict=True):
        put(view, sample)
    return cut
