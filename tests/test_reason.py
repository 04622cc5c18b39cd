"""Reasons as data: kinds, severities, and the way of both into JSON and logs."""

import json

import numpy as np
import pytest
from closed_loop import cartesian, drive, make_controller

from qpavoid import (
    Avoidance,
    Log,
    Obstacle,
    Pose,
    Problem,
    Reason,
    ReasonKind,
    Sample,
    Severity,
    Solution,
    Status,
    make_solver,
)
from qpavoid.config import Beta, Box, Sphere
from qpavoid.problem import AvoidanceRows, Tracking, make_problem

INFORMING = {"NO_BACKUP", "PLAN", "NO_PLAN", "ESTIMATED", "IGNORED", "POINTS_DROPPED", "NORMALISED", "TIMING"}
ALARMING = {
    "PREDICTED_TOO_NEAR", "UNKNOWN_DISTANCE", "BUDGET_SPENT", "IMPLAUSIBLE", "SOLVER_FAILED", "CONTACTS_INFEASIBLE",
}  # fmt: skip
BALL = Sphere(radius=0.1)


def read(entry: dict) -> Reason:
    """A reason from what `as_dict` has made of it; `detail` is for people and stays behind."""
    severity = Severity[entry["severity"]]
    return Reason(ReasonKind(entry["kind"]), tuple(entry["subject"]), entry["amount"], entry["unit"], severity)


@pytest.mark.parametrize("kind", ReasonKind)
def test_reason_kind_has_a_severity_and_a_line_for_people(kind):
    expected = "INFO" if kind.value in INFORMING else "ALARM" if kind.value in ALARMING else "WARNING"
    bare = Reason.of(kind)
    assert kind.severity is bare.severity is Severity[expected]
    assert str(bare) and str(bare) != kind.value
    line = str(Reason.of(kind, "hand", "ball", amount=0.0123, unit="m", detail="more"))
    assert line.startswith("hand - ball: ") and "12.3 mm" in line and line.endswith("(more)")
    assert Reason.of(kind, severity=Severity.INFO).severity is Severity.INFO
    assert [str(Reason.of(other)) for other in ReasonKind].count(str(bare)) == 1


@pytest.mark.parametrize("kind", ReasonKind)
def test_reason_as_json_keeps_all_but_the_detail(kind):
    for amount, unit in ((None, ""), (0.25, "m/s"), (-3.0, "rad"), (7, "-")):
        reason = Reason.of(kind, "hand", "ball", amount=amount, unit=unit)
        assert read(json.loads(json.dumps(reason.as_dict()))) == reason
        assert reason.as_dict()["text"] == str(reason)


def test_reason_key_is_of_kind_and_subject_alone():
    reason = Reason.of(ReasonKind.ROW_RELAXED, "hand", "ball", amount=0.1, unit="m/s")
    assert reason.key == reason._replace(amount=0.2, unit="m", severity=Severity.ALARM, detail="x").key
    others = reason._replace(kind=ReasonKind.STALLED), reason._replace(subject=("hand",))
    assert all(other.key != reason.key for other in others)


@pytest.mark.parametrize("field", ["reasons", "stalled", "assumptions"])
def test_severity_of_a_solution_is_the_worst_of_its_reasons(field):
    info, alarm = Reason.of(ReasonKind.ESTIMATED), Reason.of(ReasonKind.IMPLAUSIBLE)
    assert Solution(np.zeros(1)).severity is None
    assert Solution(np.zeros(1), assumptions=(info,)).severity is Severity.INFO
    mixed = Solution(np.zeros(1), assumptions=(info,), stalled=(Reason.of(ReasonKind.STALLED),))
    assert mixed.severity is Severity.WARNING
    assert mixed._replace(**{field: (info, alarm, info)}).severity is Severity.ALARM


def test_reasons_of_a_run_are_the_same_in_json_and_log(cli):
    """In Situation 1 with damper rows the sphere keeps the tool from its target for a while."""
    rows = "avoidance={d1: 0.12, d2: 0.36, offset: 0.1, row: {type: beta, near_speed: 10}}"
    result = cli("run", "situation1", "--set", "duration=4", "--set", rows, "--json", "--no-figures")
    document = json.loads(result.stdout)
    log = Log.load(document["files"][0])
    assert document["events"] == log.meta["events"] and document["events"]
    reasons = [read(entry) for *_, entries in document["events"] for entry in entries]
    stalled = [reason for reason in reasons if reason.kind is ReasonKind.STALLED]
    assert stalled and all(reason.subject == ("left_hand", "fist") for reason in stalled)
    assert all(reason.unit == "%" and 10.0 < reason.amount <= 100.0 for reason in stalled)
    counts = {level.name: int(np.sum(log.severity == level)) for level in Severity}
    assert document["severity_counts"] == counts and counts["WARNING"] > 0
    assert document["time_blocked"] == pytest.approx(0.01 * np.sum(log.stalled)) and log.stalled.any()
    assert (log.severity[log.stalled] >= Severity.WARNING).all()


# --- what each severity means ------------------------------------------------------------------------------------


def test_relaxed_row_warns_and_contact_alarms(tmp_path):
    """A tool of 50 mm between walls that ask for 60 mm, and then with a ball that comes on too fast to be left."""
    robot = cartesian(tmp_path, acceleration=None)
    walls = [Obstacle.at(n, Box(size=(0.1, 1, 1)), [x, 0, 0]) for n, x in (("left", -0.15), ("right", 0.15))]
    avoidance = Avoidance(d1=0.06, d2=0.1, row=Beta(gain=5.0, near_speed=10.0))
    between = make_controller(robot, walls, "z", avoidance=avoidance).step([0.004, 0.0, 0.0])
    assert between.status is Status.RELAXED and between.severity is Severity.WARNING
    hit = make_controller(robot, [Obstacle.at("ball", BALL, [9.0, 0, 0])], "z").step(
        np.zeros(3), obstacles={"ball": Sample.at([0.17, 0.0, 0.0], linear=[-6.0, 0.0, 0.0])}
    )
    rows = [reason for reason in hit.reasons if reason.kind is ReasonKind.ROW_RELAXED]
    assert hit.severity is Severity.ALARM and [row.severity for row in rows] == [Severity.ALARM]


def test_relaxed_row_far_from_safety_distance_informs(tmp_path):
    """At 90 mm of 100, from a ball at 1.4 m/s, which the tool's 1 m/s cannot quite leave: nothing touches for long."""
    robot = cartesian(tmp_path, axes="x", acceleration=None)
    controller = make_controller(
        robot, [Obstacle.at("ball", BALL, [9.0, 0, 0])], "x", avoidance=Avoidance(d1=0.02, d2=0.1, backup=False)
    )
    seen = {"ball": Sample.at([0.24, 0.0, 0.0], linear=[-1.4, 0.0, 0.0])}
    solution = controller.step(np.zeros(1), obstacles=seen)
    assert solution.status is Status.RELAXED
    assert {reason.kind for reason in solution.reasons} == {ReasonKind.ROW_RELAXED, ReasonKind.AT_VELOCITY_LIMIT}
    assert {reason.severity for reason in solution.reasons} == {Severity.INFO}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("given", "sigma"), [("pose", 0.5e-3), ("sample", 1e-3)])
def test_noise_at_twice_the_safety_distance_informs(tmp_path, given, sigma, seed):
    """A ball at rest beside a tool that moves past it, seen at 100 Hz with an error of up to 1 mm and 50 mm/s.

    In the first steps, the first backup trajectory may be followed while others are sought: in one of eight runs.
    """
    rng = np.random.default_rng(seed)
    controller = make_controller(
        cartesian(tmp_path, acceleration=4.0), [Obstacle.at("ball", BALL, [9.0, 0, 0])], "z", task={"max_speed": 0.3}
    )

    def seen(_):
        place = np.array([0.15 + 2.0 * 0.02, 0.0, 0.0]) + rng.normal(0.0, sigma, 3)
        return {"ball": Pose.at(place) if given == "pose" else Sample.at(place, linear=rng.normal(0.0, 0.05, 3))}

    def target(t):
        return np.array([0.0, 0.05 * np.sin(2.0 * t), 0.0])

    ticks = list(drive(controller, np.zeros(3), 500, target=target, obstacles=seen))
    near = sum(0.035 < tick.proximity.distance.min(initial=1.0) < 0.045 for tick in ticks)
    relaxed = sum(tick.solution.status is Status.RELAXED for tick in ticks)
    assert near > 40 and (20 < relaxed < 60 if given == "sample" else relaxed <= 5)  # bare poses are smoothed
    assert {tick.solution.severity for tick in ticks[10:]} <= {None, Severity.INFO}


# --- status and reasons ------------------------------------------------------------------------------------------


def squeezed(gap: float) -> Problem:
    """Two rows of one coordinate that contradict each other by so much [m/s]."""
    d, J = np.array([0.05, 0.06]), np.array([[1.0, 0.0], [-1.0, 0.0]])
    b = np.array([0.1, -0.1 + gap])
    rows = AvoidanceRows(np.arange(2), d, J, b, 0.02, 0.1, b - 1.0)
    names = [("body0", "obstacle0"), ("body1", "obstacle1")]
    return make_problem(Tracking(np.eye(2), np.ones(2), np.ones(2)), rows, -np.ones(2), np.ones(2), names)


@pytest.mark.parametrize("solver", ["qp", "qp:daqp", "hqp"])
def test_slack_within_the_tolerance_of_the_qp_is_no_relaxation(solver):
    for gap in (0.0, 1e-8, 1e-7, 5e-7, 1e-6, 1.5e-6, 1.9e-6):
        solution = make_solver(solver).solve(squeezed(gap))
        assert solution.status is Status.SOLVED and solution.reasons == (), gap
    for gap in (1e-5, 1e-3, 0.1):
        solution = make_solver(solver).solve(squeezed(gap))
        assert solution.status is Status.RELAXED
        rows = [reason for reason in solution.reasons if reason.kind is ReasonKind.ROW_RELAXED]
        assert sum(reason.amount for reason in rows) == pytest.approx(gap, abs=5e-6)
