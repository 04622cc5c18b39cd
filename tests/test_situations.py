"""The paper's two situations: every figure of the table in the method's description, in axis distances."""

from functools import cache

import numpy as np
import pytest

from qpavoid import Log, load_scenario
from qpavoid.run.simulate import simulate

OFFSET = 0.10
"""Radii of the two bodies [m]: axis distance minus surface distance in both situations."""
SOLVERS = ("tracking", "eq10-literal", "eq10", "qp")


@cache
def run(scenario: str, solver: str, *overrides: str) -> Log:
    return simulate(load_scenario(scenario, overrides, solver))


def axis_distance(log: Log) -> np.ndarray:
    return log.min_distance + OFFSET


def error_at(log: Log, t: float) -> float:
    k = round(t / 0.01)
    return float(np.linalg.norm(log.target[k] - log.tool[k]))


@pytest.mark.parametrize(
    ("scenario", "path_time", "closest", "below"), [("situation1", 8.0, 0.01, 2.1), ("situation2", 6.0, 0.005, 4.2)]
)
def test_tracking_runs_through_the_obstacle(scenario, path_time, closest, below):
    log = run(scenario, "tracking").until(path_time)
    distance = axis_distance(log)
    assert distance.min() < closest
    assert 0.01 * np.sum(distance < 0.1) == pytest.approx(below, abs=0.05)
    assert error_at(run(scenario, "tracking"), path_time + 5.0) < 1e-6
    assert log.metrics()["collided"]


@pytest.mark.parametrize("solver", ["eq10-literal", "eq10"])
@pytest.mark.parametrize(("scenario", "path_time", "bound"), [("situation1", 8.0, 2e-3), ("situation2", 6.0, 1e-2)])
def test_eq10_settles_at_half_the_influence_distance(scenario, path_time, bound, solver):
    """There α is 1; in Situation 2, the path leads past it just a little."""
    log = run(scenario, solver)
    distance = axis_distance(log)
    half = 0.5 * log.meta["config"]["avoidance"]["d2"]
    assert distance.min() == pytest.approx(half, abs=1.5e-3)
    assert error_at(log, path_time) < bound
    assert error_at(log, path_time + 5.0) < 1e-4
    assert log.metrics()["arrived"] and not log.metrics()["collided"]


def test_situation1_is_closest_at_the_third_capsule():
    log = run("situation1", "eq10-literal")
    assert log.meta["bodies"][int(np.argmin(log.body_distance.min(axis=0)))] == "left_hand"
    assert log.metrics()["min_pair"] == ["left_hand", "fist"]


@pytest.mark.parametrize(("scenario", "closest"), [("situation1", 0.18), ("situation2", 0.12)])
def test_qp_with_the_gains_of_eq10_keeps_d1(scenario, closest):
    """Rows of eq. 10's own distance rate keep its d1; all pairs count, so that it stays farther off."""
    log = run(scenario, "qp")
    metrics = log.metrics()
    assert log.meta["config"]["avoidance"]["row"]["type"] == "task-switching"
    assert closest <= axis_distance(log).min() < closest + 0.02
    assert metrics["final_error"] < 1e-4
    assert metrics["status_counts"]["RELAXED"] == metrics["status_counts"]["STOPPED"] == 0


DAMPER = "avoidance.d1=0.12", "avoidance.row={type: beta, near_speed: 10, gain: 5}"


@pytest.mark.parametrize("scenario", ["situation1", "situation2"])
def test_qp_with_damper_rows_keeps_its_safety_distance(scenario):
    log = run(scenario, "qp", *DAMPER)
    assert axis_distance(log).min() == pytest.approx(0.120, abs=5e-4)
    assert log.metrics()["final_error"] < 1e-4
    assert set(log.metrics()["status_counts"].items()) >= {("RELAXED", 0), ("STOPPED", 0)}


@pytest.mark.parametrize("d2", [0.24, 0.30])
def test_eq10_settles_at_half_of_any_influence_distance(d2):
    log = run("situation1", "eq10", f"avoidance.d2={d2}")
    assert axis_distance(log).min() == pytest.approx(d2 / 2, abs=5e-4)


@pytest.mark.parametrize(
    ("scenario", "far_away"),
    [
        ("situation1", ("obstacles=[]",)),
        ("situation2", ("avoidance.d1=0.121", "avoidance.d2=0.122", "duration=1")),
        ("panda_line", ("obstacles=[]", "avoidance.d1=0.001", "avoidance.d2=0.002", "duration=3")),
    ],
)
def test_solvers_agree_where_nothing_is_near(scenario, far_away):
    logs = [run(scenario, solver, *far_away) for solver in ("tracking", "eq10", "qp")]
    for log in logs:
        assert not np.any(log.beta)
        assert np.abs(log.v - logs[0].v).max() < 1e-6


@pytest.mark.parametrize(
    ("backend", "tolerance"), [("daqp", 1e-8), ("quadprog", 1e-8), ("proxqp", 1e-5), ("osqp", 1e-5)]
)
def test_back_ends_agree(backend, tolerance):
    reference, other = run("situation1", "qp"), run("situation1", f"qp:{backend}")
    assert set(other.metrics()["status_counts"].items()) >= {("RELAXED", 0), ("STOPPED", 0)}
    assert np.abs(other.v - reference.v).max() < tolerance


SHIFTS = np.random.default_rng(0).uniform(-0.05, 0.05, (20, 2)).round(4).tolist()
POSTURES = ("", "q0=[-1.1603, 0.6168, 0.3794, -0.7141, 1.9936, -1.5551, -1.7847, 0, 0, 0, 0, 0, 0, 0]")
"""Situation 1's own, and one with the tool at the same place and the elbow lower."""


@pytest.mark.parametrize("posture", POSTURES, ids=["elbow high", "elbow low"])
@pytest.mark.parametrize(
    ("dx", "dz"), [*SHIFTS[:2], *(pytest.param(*shift, marks=pytest.mark.slow) for shift in SHIFTS[2:])]
)
def test_solvers_pass_a_shifted_sphere(posture, dx, dz):
    """No contact in any of the 40 runs, and all arrive; eq. 10 is as good here."""
    center = [0.39644872 + dx, 0.41090125, 0.74741443 + dz]
    overrides = [f"obstacles.0.motion.position={center}", *[posture] * bool(posture)]
    for solver in ("eq10", "qp"):
        metrics = simulate(load_scenario("situation1", overrides, solver)).metrics()
        assert not metrics["collided"] and metrics["arrived"], solver
