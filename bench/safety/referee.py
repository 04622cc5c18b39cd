"""Findings of the independent checker on a log, and how far the two agree."""

from __future__ import annotations

import numpy as np

from qpavoid import Limits, Log
from qpavoid_bench.arena.checker import Findings, check_run
from qpavoid_bench.arena.mujoco_model import MujocoModel


def referee(twin: MujocoModel, log: Log) -> Findings:
    """Run a log's velocities in MuJoCo from the twin's start.

    Raises:
        ValueError: the log is of another scene.
    """
    if [list(pair) for pair in twin.scene.pair_names] != log.meta["pairs"]:
        raise ValueError("the log's pairs are not the twin's: it is of another scene")
    return check_run(twin, log.t, log.v, Limits.model_validate(log.meta["config"]["limits"]))


def drift(log: Log, findings: Findings) -> float:
    """Return the largest difference between the log's configurations and MuJoCo's [rad or m]."""
    return float(np.max(np.abs(findings.q - log.q), initial=0.0))


def disagreement(twin: MujocoModel, log: Log, findings: Findings) -> float:
    """Return the largest difference between the log's least distance and MuJoCo's of that pair [m].

    Only of control steps without contact: in deep penetration the two mean different things.
    """
    worst, ours = 0.0, log.min_distance
    for k in np.flatnonzero((ours > 0.0) & (ours < np.inf)).tolist():
        twin.place(findings.q[k], float(log.t[k]))
        worst = max(worst, abs(twin.distance(int(log.closest_pair[k])) - float(ours[k])))
    return worst
