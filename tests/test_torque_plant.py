"""A robot with torque motors in MuJoCo obeys the equations of motion that its controller counts on."""

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import ConfigError, NumericalError, Robot, load_scenario, simulate
from qpavoid.config import Payload, PlantSettings, Push

pytest.importorskip("mujoco")

from qpavoid.run.torque_plant import TorquePlant

DT = 1e-3
TOOL = "panda_hand_tcp"
CORNERS = np.array([[-0.05, 0.025, -0.035], [-0.05, -0.025, -0.035], [0.12, 0.03, -0.035], [0.12, -0.03, -0.035]])
SOLES = [(f"{side}_ankle_roll_link", CORNERS) for side in ("left", "right")]


def acceleration(model, q, v, torque, force=None, armature=0.0):
    """What pinocchio makes of torques (nv,), with a world force (3,) at the tool."""
    model = model.copy()
    model.armature[:] = armature
    data = model.createData()
    if force is not None:
        frame = model.getFrameId(TOOL)
        J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
        torque = torque + J.T @ force
    return pin.aba(model, data, q, v, torque)


@pytest.mark.parametrize("armature", [0.0, 0.1])
def test_plant_accelerates_as_forward_dynamics_does(panda, armature):
    rng = np.random.default_rng(0)
    plant = TorquePlant(panda, panda.home, PlantSettings(armature=armature))
    for _ in range(20):
        q, v, torque = plant.q, plant.v, rng.uniform(-10.0, 10.0, 7)
        expected = acceleration(panda.model, q, v, torque, armature=armature)
        plant.apply(torque, 1e-5)
        np.testing.assert_allclose((plant.v - v) / 1e-5, expected, atol=0.02 * max(1.0, np.abs(expected).max()))


def test_floating_plant_falls_and_turns_as_forward_dynamics_does():
    g1, rng = Robot.load("g1"), np.random.default_rng(1)
    plant = TorquePlant(g1, g1.home)
    assert len(plant.actuated) == 29
    for _ in range(30):
        plant.apply(rng.uniform(-2.0, 2.0, 29), DT)
    q, v, torque = plant.q, plant.v, rng.uniform(-2.0, 2.0, 29)
    expected = acceleration(g1.model, q, v, np.concatenate((np.zeros(6), torque)))
    plant.apply(torque, 1e-6)
    np.testing.assert_allclose((plant.v - v) / 1e-6, expected, atol=1e-2 * np.abs(expected).max())
    np.testing.assert_allclose(plant.q, pin.integrate(g1.model, q, 1e-6 * plant.v), atol=1e-9)


def test_masses_payload_and_push_are_what_the_settings_say(panda):
    q, payload = panda.home, Payload(frame=TOOL, mass=1.5)
    push = Push(frame=TOOL, force=(3.0, -2.0, 5.0), start=0.0)
    gravity = pin.rnea(panda.model, panda.model.createData(), q, np.zeros(7), np.zeros(7))
    data = panda.model.createData()
    weight = (
        1.5
        * 9.81
        * pin.computeFrameJacobian(panda.model, data, q, panda.model.getFrameId(TOOL), pin.LOCAL_WORLD_ALIGNED)[2]
    )

    def rest(settings, torque):
        plant = TorquePlant(panda, q, settings)
        plant.apply(torque, 1e-6)
        return np.abs(plant.v).max() / 1e-6

    limit = 1e-3
    assert rest(PlantSettings(), gravity) < limit
    assert rest(PlantSettings(mass_scale=1.2), 1.2 * gravity) < limit < rest(PlantSettings(mass_scale=1.2), gravity)
    assert rest(PlantSettings(payload=payload), gravity + weight) < limit
    plant = TorquePlant(panda, q, PlantSettings(pushes=[push]))
    plant.apply(gravity, 1e-6)
    expected = acceleration(panda.model, q, np.zeros(7), gravity, np.array(push.force))
    np.testing.assert_allclose(plant.v / 1e-6, expected, rtol=1e-4)


def test_motors_are_late_and_limited(panda):
    plant = TorquePlant(panda, panda.home, PlantSettings(delay=0.002))
    torques = []
    for k in range(5):
        plant.apply(np.full(7, 2.0 * k), DT)
        torques.append(plant.torque[0])
    assert torques == [0.0, 0.0, 0.0, 2.0, 4.0]
    for _ in range(3):
        plant.apply(np.full(7, 1e3), DT)
    np.testing.assert_array_equal(plant.torque, [87.0] * 4 + [12.0] * 3)
    with pytest.raises(NumericalError, match="torque"):
        plant.apply(np.full(7, np.nan), DT)


def test_noise_is_that_of_its_seed(panda):
    settings = PlantSettings(position_noise=1e-3, velocity_noise=1e-2, seed=3)
    first, again = (TorquePlant(panda, panda.home, settings) for _ in range(2))
    readings = np.array([np.concatenate(first.measure()) for _ in range(200)])
    np.testing.assert_array_equal(readings[0], np.concatenate(again.measure()))
    spread = np.std(readings, axis=0)
    assert spread[:7] == pytest.approx(1e-3, rel=0.25) and spread[7:] == pytest.approx(1e-2, rel=0.25)
    np.testing.assert_array_equal(first.q, panda.home)


def test_floor_carries_a_humanoid_that_is_locked_by_stiff_joints():
    g1 = Robot.load("g1")
    plant = TorquePlant(g1, g1.home, PlantSettings(damping=20.0, armature=0.1), SOLES)
    assert np.ptp(plant.point_positions()[:, 2]) < 1e-4 and len(plant.point_names) == 8
    for _ in range(300):
        plant.apply(-1000.0 * (plant.q[7:] - g1.home[7:]), DT)
    weight = 9.81 * pin.computeTotalMass(g1.model)
    forces = plant.forces()
    assert forces[:, 2].min() >= 0.0 and forces[:, 2].sum() == pytest.approx(weight, rel=0.1)
    assert (np.linalg.norm(forces[:, :2], axis=1) <= 0.7 * forces[:, 2] + 1e-6).all()
    assert plant.slip().max() < 5e-3


def test_a_plant_needs_torques():
    with pytest.raises(ConfigError, match="dynamics"):
        simulate("panda_line", plant="mujoco")
    with pytest.raises(ConfigError, match="dynamics"):
        load_scenario("panda_line", ["plant={}"])


def test_a_scenario_with_a_plant_is_played_on_it():
    """A G1 begins to wave: its log has torques, forces that carry it, and feet at rest; without the plant none."""
    log = simulate(load_scenario("g1_wave", ["duration=0.1"]))
    figures = log.metrics()
    assert log.torque.shape == (101, 29) and figures["status_counts"]["SOLVED"] == 101
    weight = 9.81 * pin.computeTotalMass(Robot.load("g1").model)
    assert log.contact_force[-1, :, 2].sum() == pytest.approx(weight, rel=0.05)
    assert figures["torque"]["share"] < 1.0 and figures["torque"]["slip"] < 1e-3
    exact = simulate(load_scenario("g1_wave", ["duration=0.01", "plant=null"]))
    assert exact.metrics()["torque"] is None and not exact.slip.size
