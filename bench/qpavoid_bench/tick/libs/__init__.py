"""One small adapter for each library.

An adapter is called with a Workload (that is the set-up, not timed) and returns an object which has

- `step(tick) -> v`: one control step from configuration number `tick`, the only thing that is timed;
- `velocity(v) -> (nv,)`: the same velocity in Pinocchio's convention;
- `frames(tick) -> (f, 4, 4)` and `distances(tick) -> (m,)`: its own forward kinematics and its own distances;
- `advance(v)`, of closed loops only: what happens between two control steps, not timed.
"""

from __future__ import annotations

from dataclasses import dataclass

from qpavoid_bench.arena.libraries.settings import PLACO_PYTHON

_OURS = (
    "Controller at its defaults; Task.gain = 1/dt, which is the dead beat that the others have by default; d1 = d_min, "
    "d2 = influence distance"
)
_PINK = (
    "SelfCollisionBarrier(d_min, gain 1.0, safe_displacement_gain 1.0) of all pairs or of the 20 closest; it has no "
    "influence distance; FrameTask(cost 1, gain 1.0, lm_damping 0); limits None: position and velocity; damping 1e-12; "
    "solver daqp"
)
_MINK = (
    "CollisionAvoidanceLimit(gain 0.85, minimum distance d_min, detection distance = influence distance, broad phase "
    "on) with the pairs given, not filtered; FrameTask(cost 1, gain 1.0, lm_damping 0); ConfigurationLimit (gain "
    "0.95), VelocityLimit; damping 1e-12; solver daqp"
)
_PLACO = (
    "avoid_self_collisions constraint (hard, margin = d_min, trigger = influence distance); frame tasks soft, weight "
    "1, full error in one step (it has no gain); joint and velocity limits on; fixed robots through mask_fbase(True): "
    "its model always has a floating base; obstacles are added to its collision model, as it has no interface for them"
)


@dataclass(frozen=True)
class Library:
    """How one column of the report is run."""

    name: str
    adapter: str
    """MODULE:NAME below qpavoid_bench.tick.libs."""
    settings: str
    """What differs from its defaults."""
    packages: tuple[str, ...]
    """Packages whose versions are reported."""
    closing_gain: float | None = None
    """ξ of its rows ḋ >= -(1 - β(d)) ξ (d - d_min), which its velocities are checked to respect [1/s]."""
    interpreter_variable: str = ""
    """Environment variable that may name another Python interpreter that has its packages, as in the arena."""
    path: str | None = None
    """Folder whose `qpavoid` is run in place of this one."""


LIBRARIES = {
    library.name: library
    for library in (
        Library("qpavoid", "ours:make", _OURS, ("qpavoid", "pin", "coal", "daqp", "numpy", "numba"), 5.0),
        Library("pink-all", "pinks:AllPairs", _PINK, ("pin-pink", "pin", "coal", "qpsolvers", "daqp", "numpy")),
        Library("pink-20", "pinks:Closest20", _PINK, ("pin-pink", "pin", "coal", "qpsolvers", "daqp", "numpy")),
        Library("mink", "minks:Mink", _MINK, ("mink", "mujoco", "qpsolvers", "daqp", "numpy")),
        Library("placo", "placos:Placo", _PLACO, ("placo", "pin", "coal", "numpy"), interpreter_variable=PLACO_PYTHON),
    )
}
"""In the order in which they take turns."""
