"""The benchmark's measures: a step beside another qpavoid, what an answer to a QP is worth, the commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import qpavoid
from qpavoid_bench.arena.commands import app
from qpavoid_bench.solvers.record import QP
from qpavoid_bench.solvers.truth import find_truth, judge
from qpavoid_bench.tick.libraries import LIBRARIES
from qpavoid_bench.tick.loops import loop_names
from qpavoid_bench.tick.report import write_report
from qpavoid_bench.tick.runner import run

OURS = LIBRARIES["qpavoid"]


def test_tick_beside_another_qpavoid(tmp_path):
    """The other one is this one: it gives the same velocities, and what is timed of both stands in one table."""
    other = replace(OURS, name="other", path=str(Path(qpavoid.__file__).parents[1]))
    results = run(
        ["panda-5@0.10", "panda-5@0.10+pose3", "far-50+sample2"], [OURS, other], rounds=2, ticks=6, budget=1.0
    )
    assert results.missing == {}
    for row in results.rows:
        mine, others = row.cells["qpavoid"], row.cells["other"]
        assert not mine.refused and not others.refused
        assert [len(ns) for ns in mine.rounds] == [len(ns) for ns in others.rounds] == [6, 6]
        if row.workload is not None:
            np.testing.assert_array_equal(mine.velocities, others.velocities)
            assert mine.distance_error < 1e-9
    text = write_report(results, tmp_path, "t")
    assert text.count("| far-50+sample2 |") == 3
    assert len((tmp_path / "t.csv").read_text().splitlines()) == 1 + 6


def test_a_library_that_disagrees_is_not_timed():
    broken = replace(OURS, name="broken", closing_gain=1e-3)  # rows that its velocities do not respect
    results = run(["panda-5@0.10"], [broken], rounds=1, ticks=4, budget=1.0)
    assert "too fast" in results.rows[0].cells["broken"].refused
    assert results.rows[0].cells["broken"].rounds == []


def qp(G, h, lower=-1.0, upper=1.0, n=3):
    """Closest point to (2, 0, 0) within bounds and rows."""
    v, A = np.array([2.0, 0.0, 0.0]), np.zeros((1, n))
    rows = np.array(G, dtype=float).reshape(-1, n)
    return QP(np.eye(n), -v, rows, np.array(h, dtype=float), np.full(n, lower), np.full(n, upper), A, v)


@pytest.mark.parametrize(
    ("G", "h", "x"),
    [
        ([], [], [1.0, 0.0, 0.0]),
        ([[-1.0, 0.0, 0.0]], [-0.25], [0.25, 0.0, 0.0]),
        ([[-1.0, 1.0, 0.0]], [-1.0], [1.0, 0.0, 0.0]),
        ([[-1.0, 1.0, 0.0]], [0.0], [1.0, 1.0, 0.0]),
    ],
)
def test_the_truth_about_a_qp_is_its_minimum(G, h, x):
    problem = qp(G, h)
    truth = find_truth(problem)
    np.testing.assert_allclose(truth.x, x, atol=1e-9)
    assert not truth.is_open
    assert judge(problem, truth, np.array(x)).right
    assert not judge(problem, truth, np.array(x) + 1e-4).right
    assert not judge(problem, truth, None).right


def test_where_rows_contradict_each_other_nothing_counts_as_found():
    problem = qp([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], [0.5, -0.4])
    truth = find_truth(problem)
    assert truth.x is None and not truth.is_open
    assert judge(problem, truth, None).solved
    assert not judge(problem, truth, np.array([0.5, 0.0, 0.0])).solved


def test_commands_list_and_refuse_by_name():
    listed = CliRunner().invoke(app, ["tick", "--list"]).output.split()
    assert {"panda-50@0.10", "g1-8@0.30", "panda-50@0.10+pose50", *loop_names()} <= set(listed)
    for arguments in (
        ["tick", "--workloads", "no-such"],
        ["tick", "--libs", "no-such"],
        ["tick", "--against", "tests"],
    ):
        assert isinstance(CliRunner().invoke(app, arguments).exception, qpavoid.ConfigError)
