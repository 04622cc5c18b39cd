"""Closed loop: run a scenario step by step and record it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pinocchio as pin

from qpavoid.config import Contact, PlantSettings, ScenarioConfig
from qpavoid.config.loading import load_scenario
from qpavoid.control.latency import CommandsUnderWay
from qpavoid.control.tick import Tick
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError, NumericalError
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, State
from qpavoid.run.log import Log
from qpavoid.solvers import Solver, parse_solver

if TYPE_CHECKING:
    from qpavoid.run.torque_plant import TorquePlant


_SHOWN = 10
"""Ticks that compiled code runs in one go at most, where somebody follows the progress [-]."""


class StartWarning(UserWarning):
    """The initial configuration is in collision or outside its limits."""


def simulate(
    scenario: ScenarioConfig | str,
    solver: str | Solver | None = None,
    progress: Callable[[int, int], None] | None = None,
    plant: Literal["mujoco"] | PlantSettings | None = None,
) -> Log:
    """Run a scenario with velocities that are followed exactly, q ⊕ v dt, after its `latency`, or with torques.

    A run that is interrupted from the keyboard, or in which the loop itself fails, gives the log of what it did;
    `meta["completed"]` is then false and `meta["stopped_by"]` says why.

    Args:
        scenario: configuration, shipped name or path.
        solver: replaces the scenario's solver, as in `eq10` or `qp:proxqp`; or a `Solver` of your own.
        progress: called with the number of ticks done and the number in all: after each, or after ten at most that
            compiled code runs in one go.
        plant: robot with torque motors in MuJoCo, `mujoco` for one that is as its model; it needs a scenario with a
            `dynamics` block. That of the scenario, if any, where it is left out. The log then has torques, and where
            contacts touch a floor, their forces and slip.

    Raises:
        ConfigError, UnknownName, SolverNotInstalled: the scenario cannot be built, or MuJoCo is not installed.
    """
    law = None if isinstance(solver, str) else solver
    if isinstance(scenario, str):
        scenario = load_scenario(scenario, solver=solver if isinstance(solver, str) else None)
    elif isinstance(solver, str):
        settings = parse_solver(solver, scenario.solver)
        scenario = scenario.model_copy(update={"solver": settings})
    if plant is not None:
        update = {"plant": PlantSettings() if plant == "mujoco" else plant}
        scenario = scenario.model_copy(update=update)
    return run(scenario, None, progress, law)


def run(
    scenario: ScenarioConfig,
    robot: Robot | None,
    progress: Callable[[int, int], None] | None = None,
    law: Solver | None = None,
) -> Log:
    """Run a scenario, see `simulate`, with its robot if that is loaded already, and by another law than its own."""
    from qpavoid.run.recorder import Recorder  # with all that measures for it: a loop of your own needs none

    controller, q = Controller.from_scenario(scenario, robot)
    if law is not None:
        controller.solver = law
    _check_start(controller, q, scenario)
    dt, ticks = scenario.dt, round(scenario.duration / scenario.dt) + 1
    follower = Follower(controller.scene.robot.model, q, scenario.latency, dt)
    motors = (
        None if scenario.plant is None else make_plant(controller.scene.robot, q, scenario.plant, scenario.contacts)
    )
    try:
        recorder = Recorder(controller, scenario, ticks, motors)
    except MemoryError:
        raise ConfigError(
            f"{scenario.source}: duration: {ticks} ticks do not fit into memory; shorten it, or lengthen dt"
        ) from None
    stopped_by, k = None, 0
    loop = controller.closed_loop() if motors is None else None
    try:
        while k < ticks:
            begin = perf_counter()
            most = ticks - k if progress is None else min(ticks - k, _SHOWN)
            count = 0 if loop is None else loop.run(follower.q, k, most)
            if loop is not None and count > 0:
                recorder.add_periods(loop.periods, count, perf_counter() - begin, loop.last)
                follower.go_on(loop.periods.q[count].copy(), loop.periods.v[count - 1].copy())
            elif motors is not None:
                recorder.add(_play(controller, motors, k * dt))
            else:
                tick = controller.tick(follower.q, k * dt, v=follower.v, copy=False)
                recorder.add(tick)
                follower.follow(tick.solution.v)
            k += max(count, 1)
            if progress is not None:
                progress(k, ticks)
    except KeyboardInterrupt:
        stopped_by = "interrupted from the keyboard"
    except NumericalError as error:
        stopped_by = str(error)
    return recorder.log(stopped_by)


def make_plant(robot: Robot, q: Array, settings: PlantSettings, contacts: Sequence[Contact]) -> TorquePlant:
    """Make a robot with torque motors, at q (nq,), on the corners of its contacts; MuJoCo is loaded for it alone.

    Raises:
        ConfigError: MuJoCo is not installed, or does not know a joint.
    """
    from qpavoid.run.torque_plant import TorquePlant

    points = [(contact.frame, np.array(contact.vertices or [(0.0, 0.0, 0.0)])) for contact in contacts]
    try:
        return TorquePlant(robot, q, settings, points)
    except ValueError as error:
        raise ConfigError(f"plant: {error}") from None


def _play(controller: Controller, plant: TorquePlant, t: float) -> Tick:
    """Take a step at t [s] by what the plant measures, and return it with the state that was true."""
    state, (q, v) = State(plant.q, plant.v, t), plant.measure()
    tick = controller.tick(q, t, v=v, copy=False)
    plant.follow(tick.solution, controller.dt)
    return tick._replace(state=state)


class Follower:
    """A robot that follows its commands exactly, q ⊕ v dt, after a latency."""

    def __init__(self, model: Any, q: Array, latency: float, dt: float) -> None:
        """Begin at rest at q (nq,); `latency` and the control period dt are in seconds."""
        self._model, self._dt, self._q_commanded = model, dt, q
        self._under_way = CommandsUnderWay(model.nv, latency, dt) if latency else None
        self.q, self.v = q, np.zeros(model.nv)
        """Configuration (nq,) and velocity (nv,), as measured."""

    def go_on(self, q: Array, v: Array) -> None:
        """Be at q (nq,), where commands without a latency have led to, the last of which was v (nv,)."""
        self.q = self._q_commanded = q
        self.v = v

    def follow(self, v: Array) -> None:
        """Hold a commanded velocity (nv,) for one control period."""
        self.v = v
        self.q = self._q_commanded = pin.integrate(self._model, self._q_commanded, v * self._dt)
        if self._under_way is not None:
            self._under_way.add(v)
            self.q = pin.integrate(self._model, self._q_commanded, -self._under_way.displacement)


def _check_start(controller: Controller, q: Array, scenario: ScenarioConfig) -> None:
    """Warn of joints outside their limits and of pairs that overlap at the start."""
    robot, source = controller.scene.robot, scenario.source
    bounds, q_now = robot.bounds(), q[robot.bounds().q_index]
    for i in np.flatnonzero((q_now < bounds.lower) | (q_now > bounds.upper)):
        joint = robot.coordinate_names[bounds.v_index[i]]
        warnings.warn(
            f"{source}: q0: {joint} = {q_now[i]:g} lies outside its limits [{bounds.lower[i]:g}, {bounds.upper[i]:g}] "
            "[rad or m]",
            StartWarning,
            stacklevel=3,
        )
    proximity = controller.tick(q, 0.0, v=np.zeros(controller.scene.robot.model.nv)).proximity
    controller.reset()  # that tick was not taken: the run begins at rest
    for i in np.flatnonzero(proximity.distance < 0.0):
        a, b = controller.scene.pair_names[proximity.pair[i]]
        depth = -1e3 * proximity.distance[i]
        warnings.warn(f"{source}: q0: {a} and {b} overlap by {depth:.1f} mm at the start", StartWarning, stacklevel=3)
