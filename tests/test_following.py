"""Where the law is stuck, a planned path is followed through its rows; a faulty worker costs no more than the plan."""

import numpy as np
import pytest
from closed_loop import Awaited

from qpavoid import Controller, ScenarioConfig, Status, simulate
from qpavoid.planning import worker
from qpavoid.reason import ReasonKind
from qpavoid_bench.arena.entrants import find_entrant
from qpavoid_bench.arena.families import load_family, make_case
from qpavoid_bench.arena.trial import run_trial

HOME = {
    "shoulder_pan_joint": -0.505, "shoulder_lift_joint": -1.543, "elbow_joint": 1.783, "wrist_1_joint": -1.504,
    "wrist_2_joint": -1.667, "wrist_3_joint": 0.0,
}  # fmt: skip
STUCK = {
    "box": (0, 1, 2, 3, 8, 11), "shelf": (0, 1, 5, 6, 7, 9, 10, 11), "narrow_gap": (1, 7), "sphere_field": (2, 4, 9),
}  # fmt: skip
"""Static cases of the suite `full` in which `qp` does not arrive."""


def gap(**planning) -> ScenarioConfig:
    """A tool that goes straight through a gap between two boxes, in which the forearm gets stuck."""
    sides = {"left": 0.347, "right": -0.232}
    motion = {"type": "waypoints", "times": [0.1, 1.5], "positions": [[0.450, -0.133, 0.314], [0.791, 0.027, 0.389]]}
    return ScenarioConfig.model_validate({
        "robot": "ur5", "q0": HOME, "duration": 5.0, "avoidance": {"d1": 0.02, "d2": 0.12},
        "tasks": [{"frame": "tool0", "motion": motion}],
        "obstacles": [
            {
                "name": name, "shape": {"type": "box", "size": [0.114, 0.295, 0.589]},
                "motion": {"type": "fixed", "position": [0.615, y, 0.350]},
            }
            for name, y in sides.items()
        ],
        "planning": planning or None,
    })  # fmt: skip


def error(log):
    return float(np.linalg.norm(log.target[-1] - log.tool[-1], axis=1).max())


def run(controller, q, steps, first=0):
    """Solutions of a loop, and where it ends."""
    solutions = []
    for k in range(first, first + steps):
        solutions.append(controller.step(q, k * controller.dt))
        q = q + controller.dt * solutions[-1].v
    return solutions, q


def test_path_is_followed_where_the_law_is_stuck():
    """And no nearer to anything than the safety distance."""
    law, planned = simulate(gap()), simulate(gap(settle=3.0))
    assert error(law) > 0.05
    assert error(planned) < 1e-3
    assert planned.body_distance.min() > 0.02 - 1e-4
    (event,) = [event for _, _, reasons in planned.meta["events"] for event in reasons if event["kind"] == "PLAN"]
    assert event["text"].startswith("plan followed (path from ")
    assert (planned.status == list(Status).index(Status.SOLVED)).all()


def test_runs_are_reproducible_and_say_what_is_followed_and_why():
    controller, q = Controller.from_scenario(gap(settle=3.0))
    solutions, _ = run(controller, q, 500)
    controller.reset()
    again, _ = run(controller, q, 500)
    assert [solution.v.tobytes() for solution in solutions] == [solution.v.tobytes() for solution in again]
    (text,) = {solution.plan for solution in solutions} - {""}
    assert text.startswith("path from ")
    assert "the present drive would end " in text
    assert ", stalled at " in text
    assert not solutions[-1].plan


def test_no_clearances_no_paths():
    controller, q = Controller.from_scenario(gap(settle=3.0, clearances=[]))
    solutions, _ = run(controller, q, 300)
    assert not any("path" in solution.plan for solution in solutions)


class Faulty(worker.InlineWorker):
    """A worker that spoils its answers."""

    fault = ""

    def poll(self):
        answer = super().poll()
        if answer is None or answer.outcome.decision is None:
            return answer
        outcome = answer.outcome
        decision = outcome.decision
        path = decision.drive.path
        match self.fault:
            case "dead":
                return worker.Answer(-1, None, "the process has ended")
            case "late":
                return answer._replace(outcome=outcome._replace(decision=decision._replace(t=-1.0)))
            case "NaN":
                path.q[:] = np.nan
            case "shape":
                return answer._replace(outcome=outcome._replace(expected=outcome.expected._replace(q=np.zeros((3, 2)))))
            case "silent":
                return None
        return answer


@pytest.mark.parametrize("fault", ["dead", "late", "NaN", "shape", "silent"])
def test_faulty_worker_costs_no_more_than_the_plan(fault, monkeypatch):
    """Commands are those of the law, bit for bit; what cannot be used is named."""
    monkeypatch.setattr(Faulty, "fault", fault)
    monkeypatch.setattr(worker, "InlineWorker", Faulty)
    controller, q = Controller.from_scenario(gap(settle=3.0))
    alone, _ = Controller.from_scenario(gap())
    solutions, _ = run(controller, q, 100)
    of_law, _ = run(alone, q, 100)
    assert [solution.v.tobytes() for solution in solutions] == [solution.v.tobytes() for solution in of_law]
    named = [reason for reason in solutions[-1].assumptions if reason.kind is ReasonKind.NO_PLAN]
    assert len(named) == (fault not in ("late", "silent"))


def test_worker_that_raises_is_named(monkeypatch):
    def fail(*_):
        raise RuntimeError("no memory")

    monkeypatch.setattr("qpavoid.planning.candidates.Candidates.look", fail)
    controller, q = Controller.from_scenario(gap(settle=3.0))
    (solution,), _ = run(controller, q, 1)
    assert "no memory" in solution.assumptions[-1].detail


@pytest.mark.slow
def test_process_answers_as_the_step_itself_would(monkeypatch):
    """A loop that waits for each answer gets the same commands; one whose process ends goes on with the law."""
    processes = []

    class Known(Awaited):
        def __init__(self, parts):
            super().__init__(parts)
            processes.append(self.process)

    monkeypatch.setattr(worker, "ProcessWorker", Known)
    controller, q = Controller.from_scenario(gap(settle=3.0, worker="process"))
    inline, _ = Controller.from_scenario(gap(settle=3.0))
    solutions, q_end = run(controller, q, 150)
    expected, _ = run(inline, q, 150)
    assert [solution.v.tobytes() for solution in solutions] == [solution.v.tobytes() for solution in expected]
    processes[0].kill()
    processes[0].wait()
    controller.reset()
    solutions, _ = run(controller, q_end, 50)
    assert solutions[-1].assumptions[-1].subject == ("worker",)


def test_obstacle_put_into_the_path_is_kept_clear_of():
    """While the path is followed, a ball appears at its end: rows keep the safety distance."""
    scenario = gap(settle=3.0)
    ball = {
        "name": "ball", "shape": {"type": "sphere", "radius": 0.05}, "source": "external",
        "motion": {"type": "fixed", "position": [2.0, 0.0, 0.4]},
    }  # fmt: skip
    fields = scenario.model_dump()
    scenario = ScenarioConfig.model_validate({**fields, "obstacles": [*fields["obstacles"], ball]})
    controller, q = Controller.from_scenario(scenario)
    position, nearest, is_put = np.array([2.0, 0.0, 0.4]), np.inf, False
    for k in range(400):
        tick = controller.tick(q, k * 0.01, obstacles={"ball": position})
        if tick.solution.plan and not is_put:
            position, is_put = np.array([0.79, 0.03, 0.39]), True
        nearest = min(nearest, tick.problem.avoidance.d.min(initial=np.inf))
        q = q + 0.01 * tick.solution.v
    assert is_put
    assert nearest > 0.02 - 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("family", "seed"), [(family, seed) for family, seeds in STUCK.items() for seed in seeds])
def test_stuck_case_of_the_arena_arrives(family, seed):
    result = run_trial(make_case(load_family(family), seed), find_entrant("qp-planning"))
    assert result.success
    assert result.violations == 0.0
