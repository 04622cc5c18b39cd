"""What touches a Panda with friction and masses that the observer does not know is found within hundredths of a second.

`pytest -m slow -s tests/test_observer.py` prints the figures of docs/dynamics.md.
"""

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import Controller, build_scene, build_tasks
from qpavoid.config import Dynamics, Observer, PlantSettings, Push, Task
from qpavoid.control.observer import MomentumObserver

pytest.importorskip("mujoco")

from qpavoid.run.torque_plant import TorquePlant

DT, TOOL, RATES = 1e-3, "panda_hand_tcp", np.array([1.0, 0.8, 1.2, 0.9, 1.1, 1.3, 0.7])
SPEED = 0.45
"""Largest speed of each joint [rad/s]."""
PUSHES = [(20.0, 0.0, 0.0), (0.0, 20.0, 0.0), (0.0, 0.0, 20.0), (0.0, 0.0, -20.0)]


@pytest.fixture(scope="module")
def model(panda):
    model = panda.model.copy()
    model.armature = np.full(7, 0.1)
    return model


def make_observer(panda, model, **fields):
    return MomentumObserver(model, Observer(**fields), tuple(panda.coordinate_names), tuple(panda.coordinate_units))


def move(panda, model, observer, duration, pace=1.0, push=None, **fields):
    """Sinusoids of all joints under inverse dynamics; returns times and reasons of what the observer finds."""
    pushes = [Push(frame=TOOL, force=push, start=1.5, duration=0.3)] if push else []
    plant = TorquePlant(panda, panda.home, PlantSettings(armature=0.1, pushes=pushes, **fields))
    observer.reset()
    data, torque, found, rates = model.createData(), np.zeros(7), [], pace * RATES
    for k in range(round(duration / DT)):
        t, (q, v) = k * DT, plant.measure()
        found += [(t, reason) for reason in observer.update(q, v, torque, DT)]
        s, offset, speed = min(t, 1.0), SPEED / RATES * np.sin(rates * t), SPEED * pace * np.cos(rates * t)
        lacking = 400.0 * (panda.home + s * offset - q) + 40.0 * (s * speed + float(t < 1.0) * offset - v)
        plant.apply(pin.rnea(model, data, q, v, lacking - s * rates**2 * offset), DT)
        torque = plant.torque
    return found


def test_residual_is_the_torque_of_a_push(panda, model):
    """With an exact model, to the integration of the plant."""
    observer, force = make_observer(panda, model), np.array([5.0, -10.0, 8.0])
    plant = TorquePlant(
        panda,
        panda.home,
        PlantSettings(armature=0.1, pushes=[Push(frame=TOOL, force=tuple(force), start=0.0, duration=1.0)]),
    )
    data, torque = model.createData(), np.zeros(7)
    for _ in range(250):
        q, v = plant.measure()
        observer.update(q, v, torque, DT)
        plant.apply(pin.rnea(model, data, q, v, -40.0 * v), DT)
        torque = plant.torque
    J = pin.computeFrameJacobian(model, data, q, model.getFrameId(TOOL), pin.LOCAL_WORLD_ALIGNED)[:3]
    np.testing.assert_allclose(observer.residual, J.T @ force, atol=0.05)


def test_nothing_is_touched_before_thresholds_are_known(panda, model):
    observer = make_observer(panda, model)
    assert not move(panda, model, observer, 1.7, push=PUSHES[0])
    observer = make_observer(panda, model, threshold={"panda_joint1": 1.0})
    found = move(panda, model, observer, 1.7, push=PUSHES[1])
    assert {reason.subject for _, reason in found} == {("panda_joint1",)} and observer.is_touched
    assert found[0][1].kind.value == "TOUCHED" and abs(found[0][1].amount) > 1.0 and found[0][1].unit == "Nm"


@pytest.mark.slow
@pytest.mark.parametrize("mass_scale", [1.0, 0.95, 1.05])
def test_pushes_are_found_and_free_motion_is_not(panda, model, mass_scale):
    unknown = {"friction": 0.3, "damping": 0.5, "mass_scale": mass_scale}
    observer = make_observer(panda, model)
    observer.learn()
    move(panda, model, observer, 60.0, **unknown)
    threshold = observer.finish_learning()
    assert not [found for pace in (-1.0, 0.9, 0.6) if (found := move(panda, model, observer, 8.0, pace, **unknown))]
    delays = []
    for push in PUSHES:
        found = move(panda, model, observer, 1.8, 0.9, push, **unknown)
        delays.append(round(1e3 * (found[0][0] - 1.5)) if found else None)
    print(f"\nmasses {mass_scale}: thresholds {np.round(threshold, 2)} Nm, found after {delays} ms")
    assert None not in delays and min(delays) >= 0 and max(delays) <= 32


def test_controller_observes_and_stops(panda):
    """Touched beyond its threshold, the robot brakes and rests until `reset`, and says which joint it was."""
    observer = Observer(stop=True, threshold=dict.fromkeys(panda.coordinate_names, 3.0))
    tasks = build_tasks([Task(frame=TOOL)], panda, panda.home)
    dynamics = Dynamics(armature=0.1, observer=observer)
    controller = Controller(build_scene(panda), tasks, dt=DT, dynamics=dynamics)
    push = Push(frame=TOOL, force=(0.0, 20.0, 0.0), start=0.05, duration=0.05)
    plant, statuses = TorquePlant(panda, panda.home, PlantSettings(armature=0.1, pushes=[push])), []
    for k in range(150):
        q, v = plant.measure()
        solution = controller.step(q, k * DT, v=v)
        statuses.append(solution.status.value)
        if "STOPPED" in statuses and statuses[-2] == "SOLVED":
            assert "TOUCHED" in {reason.kind.value for reason in solution.reasons}
            assert np.abs(solution.external).max() > 3.0
        plant.apply(solution.torque, DT)
    first = statuses.index("STOPPED")
    assert 50 < first < 70 and set(statuses[:first]) == {"SOLVED"} and set(statuses[first:]) == {"STOPPED"}
    assert np.abs(plant.v).max() < 0.01 and controller.observer.is_touched
    controller.reset()
    assert controller.step(plant.q, 0.0, v=plant.v).status.value == "SOLVED"
