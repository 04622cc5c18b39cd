"""Memory of a robot that stands on its torques, and what contacts and base leave in a step."""

from __future__ import annotations

from typing import NamedTuple

from qpavoid.problem import Array, IntArray, Mask


class StandingArrays(NamedTuple):
    """Memory of a robot that stands: n coordinates, f contacts, k contact points."""

    mass: Array
    """(n, n) mass matrix; its upper triangle is read, the lower one written."""
    bias: Array
    """(n,) Coriolis, centrifugal and gravity torques [Nm or N]."""
    frame_ids: IntArray
    """(f,) frames in contact."""
    support: Array
    """(f, e) 1 of the columns that move each frame, else 0."""
    anchors: Array
    """(f, 12) poses at which they rest: rotation by columns, then position [m]."""
    gains: Array
    """(f,) feedback on what has slid [1/s]."""
    surfaces: Mask
    """(f,) whether it may not turn, either."""
    shares: Array
    """(f,) how far each bears what it may; 0 off the ground [-]."""
    leaves: Mask
    """(f,) whether it is about to leave."""
    steps: Array
    """(f,) κ_c: part of the way to rest that one step makes [-]."""
    normals: Array
    """(f, 3) direction in the frame in which the ground pushes, of length 1."""
    friction: Array
    """(f,) μ."""
    force: Array
    """(f, 2) least and largest normal force of each point [N]."""
    points: Array
    """(k, 3) contact points, in their frames [m]."""
    owners: IntArray
    """(k,) contact of each point."""
    weight: Array
    """(1,) of the robot [N]."""
    center: Array
    """(3,) centre of mass, world [m]."""
    center_jacobian: Array
    """(3, n) its Jacobian."""
    jacobians: Array
    """(f, 6, n) scratch: Jacobians of the frames."""
    solved: Array
    """(n + 3 k,) out: (v, p) of a settled step, with p in N s."""
    support_margin: float
    """Least distance of the capture point to the edges of the support [m]; negative: none is kept."""
    scale: float
    """s: what an impulse of 1 N s counts beside velocities."""


class Stance(NamedTuple):
    """What contacts and base leave in a step: c rows, m = 3 impulses of each active point; see `eliminate_base`."""

    J: Array
    """(c, n) rows of the contacts."""
    b: Array
    """(c,) velocity that brings them to where they rest [m/s, rad/s]."""
    b_approached: Array
    """(c,) the part of it that this step makes, from the measured velocity on."""
    K: Array
    """(·, n) orthonormal basis of these rows."""
    Z: Array
    """(n, ·) orthonormal basis of what they leave."""
    resting: Array
    """(n,) least v with J v = b."""
    approached: Array
    """(n,) least v with J v = b_approached."""
    used: IntArray
    """(m / 3,) active points, by number."""
    Jp: Array
    """(m, n) Jacobian of these points."""
    normals: Array
    """(m / 3, 3) direction in which the ground pushes, world."""
    X: Array
    """(n + m, ·); not orthonormal, see `make_orthonormal`."""
    start: Array
    """(n + m,)."""
    Y: Array
    """(m, 6)."""
    rows: Array
    """(t + 2 m + e, n + m) of torque limits, then cones, then balance, in x = (v, s p)."""
    rhs: Array
    """(t + 2 m + e,)."""
    hard: int
    """How many of the rows are never relaxed: all but those of balance."""
    is_held: bool
    """Whether the points can carry any wrench; else what is about impulses is not written."""
