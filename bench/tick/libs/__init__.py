"""One small adapter for each library.

An adapter is a class whose constructor takes a Workload (that is the set-up, not timed) and which has

- `step(tick) -> v`: one control step from configuration number `tick`, the only thing that is timed;
- `velocity(v) -> (nv,)`: the same velocity in Pinocchio's convention;
- `frames(tick) -> (f, 4, 4)` and `distances(tick) -> (m,)`: its own forward kinematics and its own distances;
- `settings`: what differs from its defaults, for the report;
- `closing_gain`, optional: ξ of the rows ḋ >= -(1 - β(d)) ξ (d - d_min), which its velocities are checked to respect;
- `packages`: whose versions are reported.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Library:
    """How one column of the report is run."""

    name: str
    adapter: str
    """MODULE:CLASS below bench.tick.libs."""
    own_python: bool = False
    """Whether it needs the environment bench/.venv-placo."""


LIBRARIES = {
    library.name: library
    for library in (
        Library("qpavoid", "ours:Ours"),
        Library("pink-all", "pinks:AllPairs"),
        Library("pink-20", "pinks:Closest20"),
        Library("mink", "minks:Mink"),
        Library("placo", "placos:Placo", own_python=True),
    )
}
"""In the order in which they take turns."""
