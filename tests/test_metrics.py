"""Key figures of logs written by hand, whose answers can be worked out on paper."""

import io
import json
from dataclasses import fields

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from qpavoid import Log
from qpavoid.reason import Reason, ReasonKind, Severity
from qpavoid.run.log import STATUSES
from qpavoid.run.metrics import path_deviation, point_segment_distance
from qpavoid.run.report import failed, metrics_table, outcome, to_json

DT = 0.1


def make_log(ticks: int, meta: dict | None = None, **arrays) -> Log:
    """A log of two joints, one task and two bodies in which everything that is not given rests at zero, far away."""
    shapes = {
        "q": (2,), "v": (2,), "target": (1, 3), "tool": (1, 3), "tool_rotation": (1, 3, 3), "turn_error": (1,),
        "body_distance": (2,), "body_pair": (2,), "body_ends": (2, 2, 3), "obstacle_position": (1, 3),
        "obstacle_rotation": (1, 3, 3), "torque": (0,), "contact_force": (0, 3), "slip": (0,),
    }  # fmt: skip
    rows = {f.name: np.zeros((ticks, *shapes.get(f.name, ()))) for f in fields(Log) if f.name != "meta"}
    rows |= {"t": DT * np.arange(ticks), "body_distance": np.full((ticks, 2), np.inf)}
    rows |= {"closest_pair": np.full(ticks, -1), "status": np.zeros(ticks, dtype=np.int8)}
    config = {"dt": DT, "goal_tolerance": 0.2, "thresholds": [0.0, 0.1, 0.2]}
    names = {"scenario": "by hand", "solver": "qp", "completed": True, "stopped_by": None, "torque_limit": []}
    names["events"] = [
        [0.1 * i, "RELAXED", [Reason.of(ReasonKind.ROW_RELAXED, "hand", "ball", amount=0.1 * i, unit="m/s").as_dict()]]
        for i in range(min(ticks, 3))
    ]
    pairs = [["upper arm", "ball"], ["hand", "ball"]]
    given = {name: np.asarray(array) for name, array in arrays.items()}
    return Log(**{**rows, **given}, meta={**names, "config": config, "pairs": pairs, **(meta or {})})


@pytest.fixture
def log():
    target = np.zeros((5, 1, 3))
    target[:, 0, 0] = [0, 1, 2, 3, 4]
    off = [[0, 0, 0], [0, 0.3, 0], [0, 0.3, 0.4], [-1, 0, 0], [0, 0, 0.1]]  # the fourth is late, but on the path
    return make_log(
        5,
        target=target,
        tool=target + np.array(off)[:, None],
        v=[[0, 0], [1, -2], [1, 1], [-3, 1], [0, 0]],
        body_distance=[[0.3, 0.5], [0.1, 0.5], [0.2, -0.02], [0.4, -0.01], [0.05, 0.06]],
        closest_pair=[0, 0, 1, 1, 0],
        status=[STATUSES.index(s) for s in ("SOLVED", "RELAXED", "RELAXED", "STOPPED", "SOLVED")],
        command_scale=[1.0, 0.5, 1.0, 0.0, 1.0],
        stalled=np.array([False, False, True, True, True]),
        planned=np.zeros(5, dtype=bool),
        severity=np.array([0, Severity.WARNING, Severity.WARNING, Severity.ALARM, Severity.INFO], dtype=np.int8),
        build_time=np.array([4, 5, 6, 7, 8]) * 1e-6,
        solve_time=np.array([6, 15, 24, 33, 92]) * 1e-6,
    )


def test_every_figure_of_a_run(log):
    assert log.metrics() == {
        "scenario": "by hand",
        "solver": "qp",
        "completed": True,
        "arrived": True,
        "collided": True,
        "min_distance": -0.02,
        "min_pair": ["hand", "ball"],
        "time_in_collision": pytest.approx(2 * DT),
        "time_below": {"0.0": pytest.approx(2 * DT), "0.1": pytest.approx(3 * DT), "0.2": pytest.approx(4 * DT)},
        "final_error": pytest.approx(0.1),
        "task_errors": {},
        "max_deviation": pytest.approx(0.5),
        "tracking_rmse": pytest.approx(np.sqrt((0.3**2 + 0.5**2 + 1.0**2 + 0.1**2) / 5)),
        "peak_velocity": 3.0,
        "jitter": pytest.approx(3 + 3 + 4 + 4),
        "torque": None,
        "status_counts": {"SOLVED": 2, "RELAXED": 2, "STOPPED": 1},
        "relaxed_ticks": 2,
        "shortened_ticks": 2,
        "time_blocked": pytest.approx(3 * DT),
        "severity_counts": {"INFO": 1, "WARNING": 2, "ALARM": 1},
        "events": log.meta["events"],
        "tick_us": {"p50": pytest.approx(30.0), "p99": pytest.approx(97.6), "max": pytest.approx(100.0)},
    }


def test_figures_of_motors():
    """Σ|Δτ| of 1 + 4 + 2 Nm in 0.3 s; a motor without a limit uses no share of it."""
    torque, slip = [[0.0, 1.0], [1.0, 5.0], [1.0, 3.0]], [[0.0], [2e-3], [1e-3]]
    metrics = make_log(3, {"torque_limit": [2.0, None]}, torque=torque, slip=slip).metrics()
    assert metrics["torque"] == {"share": 0.5, "jitter": pytest.approx(7.0 / 0.3), "slip": 2e-3}


def test_contact_without_penetration_is_no_collision():
    metrics = make_log(2, body_distance=[[0.1, 0.1], [0.0, 0.1]], closest_pair=[0, 0]).metrics()
    assert metrics["min_distance"] == 0.0
    assert not metrics["collided"]
    assert metrics["time_in_collision"] == 0.0


def test_the_worst_task_counts_for_error_and_deviation():
    target, tool = np.zeros((3, 2, 3)), np.zeros((3, 2, 3))
    tool[:, 0, 2], tool[:, 1, 2] = 0.1, [0.7, 0.4, 0.3]
    metrics = make_log(3, target=target, tool=tool).metrics()
    assert metrics["final_error"] == pytest.approx(0.3)
    assert metrics["max_deviation"] == pytest.approx(0.7)
    assert not metrics["arrived"]


def test_deviation_is_from_the_path_not_from_the_target_or_the_corners():
    """The target is recorded at x = 0, 1 and 2; the tool rounds a half circle of radius 0.3 about x = 0.5."""
    angle = np.linspace(np.pi, 0, 5)
    tool = np.stack((0.5 + 0.3 * np.cos(angle), 0.3 * np.sin(angle), np.zeros(5)), axis=-1)[:, None]
    target = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0, 0], [2, 0, 0]], dtype=float)[:, None]
    deviation = path_deviation(tool, target)
    assert np.allclose(deviation[:, 0], 0.3 * np.sin(angle), atol=1e-12)


def test_deviation_of_a_long_run_is_off_by_the_sagitta_at_most():
    """3000 points of a circle drawn as a polyline of 99 pieces: the longest spans 31 of the steps."""
    angle = np.linspace(0, 2 * np.pi, 3000)
    circle = np.stack((np.cos(angle), np.sin(angle), 0 * angle), axis=-1)[:, None]
    deviation = path_deviation(circle, circle, corners=100)
    assert np.max(deviation) == pytest.approx(1 - np.cos(31 * angle[1] / 2), rel=0.01)


def test_nothing_paired_has_no_distance():
    metrics = make_log(3).metrics()
    assert metrics["min_distance"] is None
    assert metrics["min_pair"] is None
    assert not metrics["collided"]
    assert json.loads(to_json(metrics))["min_distance"] is None


def test_run_that_ended_before_its_first_tick():
    log = make_log(0, {"completed": False})
    metrics = log.metrics()
    assert not metrics["completed"]
    assert not metrics["arrived"]
    assert np.isnan(metrics["final_error"])
    assert metrics["jitter"] == metrics["max_deviation"] == metrics["time_in_collision"] == 0.0
    assert failed(metrics)
    document = json.loads(to_json(metrics))
    assert document["final_error"] is None
    assert document["tick_us"]["p50"] is None


def test_json_is_strict():
    document = {"a": float("nan"), "b": [float("inf"), -float("inf"), 1.5], "c": {"d": (np.float64("nan"), 2)}}
    assert json.loads(to_json(document)) == {"a": None, "b": [None, None, 1.5], "c": {"d": [None, 2]}}


def test_nan_velocity_is_not_hidden():
    metrics = make_log(2, v=[[0, 1], [np.nan, 0]]).metrics()
    assert np.isnan(metrics["peak_velocity"])
    assert np.isnan(metrics["jitter"])


@pytest.mark.parametrize(
    ("changes", "bad", "words"),
    [
        ({}, False, "arrived"),
        ({"status_counts": {"SOLVED": 1, "RELAXED": 1, "STOPPED": 0}}, False, "1 relaxed, arrived"),
        ({"severity_counts": {"INFO": 0, "WARNING": 7, "ALARM": 0}}, False, "7 warning, arrived"),
        ({"severity_counts": {"INFO": 4, "WARNING": 3, "ALARM": 2}}, False, "2 alarm, 3 warning, 4 info, arrived"),
        ({"time_blocked": 1.26}, False, "stalled 1.3 s, arrived"),
        ({"arrived": False}, False, "short of goal"),
        ({"collided": True}, True, "collided, arrived"),
        ({"status_counts": {"SOLVED": 1, "RELAXED": 0, "STOPPED": 1}}, True, "1 stopped, arrived"),
        ({"completed": False, "arrived": False}, True, "broken off, short of goal"),
    ],
)
def test_outcome_in_words_and_as_failure(changes, bad, words):
    run = make_log(2, body_distance=np.ones((2, 2)), closest_pair=[0, 0]).metrics() | changes
    assert failed(run) is bad
    console = Console(width=80)
    assert console.render_str(outcome(run)).plain == words


def printed(runs: list[dict], width: int = 80) -> list[str]:
    """Lines of the table in a terminal of so many columns."""
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(metrics_table(runs, width))
    return console.export_text().splitlines()


def test_table_holds_the_figures(log):
    lines = printed([log.metrics(), make_log(2).metrics() | {"solver": "eq10-literal"}])
    cells = {line.split()[0]: line.split()[1:] for line in lines if line.strip()}
    assert cells["qp"][:6] == ["-20.0", "0.20", "100.00", "500.0", "3.00", "14.0"]
    assert cells["eq10-literal"][0] == "-"
    assert max(map(cell_len, lines)) <= 80


@pytest.mark.parametrize("width", [80, 60, 48])
def test_table_cuts_no_outcome_however_narrow(log, width):
    wide = log.metrics() | {"min_distance": -0.3, "time_in_collision": 12.5, "final_error": 0.23, "max_deviation": 0.5}
    runs = [
        wide | {"solver": solver, "collided": collided, "time_blocked": stalled, "tick_us": {"p50": 1234.0}}
        for solver in ("tracking", "eq10-literal", "gradient-projection")
        for collided in (False, True)
        for stalled in (0.0, 12.3)
    ]
    for run in runs:
        lines = printed([run], width)
        assert max(map(cell_len, lines)) <= width and "…" not in "".join(lines)
        words = " ".join(lines).split()
        said = Console().render_str(outcome(run)).plain.split()
        start = words.index(said[0], words.index(run["solver"]))
        assert [word for word in words[start:] if word in said] == said


def test_point_beyond_an_end_of_a_segment():
    """The axial 3 counts: eq. 2 as printed says 4. A segment of no length is a point."""
    p, a = np.array([[-3, 0, 4], [0.5, 3, 4], [5, 3, 0], [0.25, 0, 0]]), np.zeros(3)
    np.testing.assert_allclose(point_segment_distance(p, a, np.array([1.0, 0, 0])), [5.0, 5.0, 5.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(point_segment_distance(p, a, a), np.linalg.norm(p, axis=1), atol=1e-9)
