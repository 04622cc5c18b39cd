"""Control periods in compiled code: `simulate` gives the numbers of the same loop of single steps, bit for bit."""

from dataclasses import fields

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import Controller, load_scenario, simulate
from qpavoid.run.log import Log
from qpavoid.run.recorder import Recorder

TIMES = ("build_time", "solve_time")


def shortened(name, duration, **avoidance):
    """A shipped scenario that ends earlier, and what is changed in its avoidance."""
    scenario = load_scenario(name)
    block = scenario.avoidance.model_copy(update=avoidance)
    return scenario.model_copy(update={"duration": duration, "avoidance": block})


def by_single_steps(scenario):
    """Log of a scenario whose steps are taken one by one, as a user's own loop takes them."""
    controller, q = Controller.from_scenario(scenario)
    model, v = controller.scene.robot.model, np.zeros(controller.scene.robot.model.nv)
    count = round(scenario.duration / scenario.dt) + 1
    recorder = Recorder(controller, scenario, count)
    for k in range(count):
        tick = controller.tick(q, k * scenario.dt, v=v, copy=False)
        recorder.add(tick)
        v = tick.solution.v
        q = pin.integrate(model, q, v * scenario.dt)
    return recorder.log()


@pytest.mark.parametrize(
    "scenario",
    [
        shortened("panda_line", 7.0),  # stop look-ahead, backup trajectories
        shortened("panda_line", 7.0, backup=False),
        shortened("moving_sphere", 6.0),
        shortened("crossing_arms", 3.0),
        shortened("stall", 6.0),  # a task that stalls
        shortened("carried_box", 1.0),  # not plain: something is attached
    ],
    ids=lambda scenario: scenario.source.stem,
)
def test_the_log_of_a_run_is_that_of_single_steps(scenario):
    run, steps = simulate(scenario), by_single_steps(scenario)
    for field in fields(Log):
        if field.name not in (*TIMES, "meta"):
            np.testing.assert_array_equal(getattr(run, field.name), getattr(steps, field.name), field.name)
    assert run.meta["events"] == steps.meta["events"]


def test_steps_that_look_ahead_are_taken_in_compiled_code(monkeypatch):
    scenario, taken, tick = shortened("panda_line", 12.0, backup=False), [], Controller.tick

    def counted(controller, *arguments, **options):
        taken.append(arguments)
        return tick(controller, *arguments, **options)

    monkeypatch.setattr(Controller, "tick", counted)
    simulate(scenario)
    assert len(taken) < 10  # those that build and begin the run; 69 steps look ahead


def test_plain_steps_end_where_something_else_decides():
    scenario = load_scenario("panda_line")
    controller, q = Controller.from_scenario(scenario)
    loop = controller.closed_loop()
    assert loop.run(q, 0, 100) == 0  # the first step begins at rest: not one of those that go on
    q = pin.integrate(controller.scene.robot.model, q, scenario.dt * controller.step(q, 0.0).v)
    assert loop.run(q, 1, 100) == 100
    np.testing.assert_array_equal(loop.periods.t[:100], scenario.dt * np.arange(1, 101))
    controller.filter(loop.periods.q[100].copy(), np.zeros(7), 1.01)
    assert loop.run(loop.periods.q[100].copy(), 102, 50) == 50
    assert loop.run(q, 500, 10) == 0  # time does not go on so


@pytest.mark.parametrize("change", [{"latency": 0.02}, {"budget": 1.0}])
def test_there_is_no_compiled_loop_where_no_step_is_plain(change):
    controller, _ = Controller.from_scenario(load_scenario("panda_line").model_copy(update=change))
    assert controller.closed_loop() is None
