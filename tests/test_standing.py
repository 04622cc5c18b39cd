"""A humanoid stands on its torques: equations of motion, cones, and a ball that crosses its waving hand in MuJoCo.

`pytest -m slow -s tests/test_standing.py` prints the figures of docs/dynamics.md.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Obstacle,
    Robot,
    Sample,
    Status,
    UnknownName,
    build_contacts,
    build_scene,
    build_tasks,
    load_scenario,
    simulate,
)
from qpavoid.config import Beta, ComTask, Contact, Dynamics, Observer, PlantSettings, PostureTask, Push, Sphere, Task

pytest.importorskip("mujoco")

from qpavoid.run.torque_plant import TorquePlant

DT, HAND, FEET = 1e-3, "right_rubber_hand", ("left_ankle_roll_link", "right_ankle_roll_link")
CORNERS = [(-0.05, 0.025, -0.035), (-0.05, -0.025, -0.035), (0.12, 0.03, -0.035), (0.12, -0.03, -0.035)]
D1 = 0.015


@pytest.fixture(scope="module")
def g1():
    return Robot.load("g1")


def make_contacts(robot, friction=0.5, **fields):
    return build_contacts(
        [Contact(frame=f, vertices=CORNERS, friction=friction, **fields) for f in FEET], robot, robot.home
    )


def make_controller(robot, solver="qp", friction=0.5, contacts=None, priorities=(1, 1), **dynamics):
    tasks = [
        Task(frame=HAND, gain=3.0, priority=priorities[1]),
        Task(frame="pelvis", type="orientation", orientation_weight=0.3, gain=3.0, priority=priorities[0]),
        ComTask(gain=3.0, weight=10.0, priority=priorities[0]),  # balance first: a heel that lifts is a foot that slips
        PostureTask(weight=0.01, gain=2.0, priority=priorities[1]),
    ]
    ball = Obstacle.at("ball", Sphere(radius=0.06), [0.3, -1.0, 0.12])
    return Controller(
        build_scene(robot, [ball]), build_tasks(tasks, robot, robot.home), solver, DT,
        Avoidance(d1=D1, d2=0.08, row=Beta(gain=5.0, near_speed=10.0)),
        contacts=contacts or make_contacts(robot, friction),
        dynamics=Dynamics(**{"tracking_rate": 60.0, "row_rate": 300.0, "armature": 0.01, **dynamics}),
    )  # fmt: skip


def wave(t, start):
    """A reach of 2 s, then circles of the hand every 4 s."""
    s, rate = min(0.5 * t, 1.0), 0.5 * np.pi
    phase = rate * max(t - 2.0, 0.0)
    along = np.array([0.22, 0.05, 0.15])
    offset = np.array([0.0, 0.12 * np.sin(phase), 0.08 * (1.0 - np.cos(phase))])
    speed = np.array([0.0, 0.12 * rate * np.cos(phase), 0.08 * rate * np.sin(phase)])
    if t < 2.0:
        speed = 15.0 * s**2 * (1.0 - s) ** 2 * along
    return Sample.at(start + along * s**3 * (10.0 - 15.0 * s + 6.0 * s * s) + offset, linear=speed)


def crossing(t):
    return Sample.at([0.3, -1.0 + 0.3 * t, 0.12], linear=[0.0, 0.3, 0.0])


@dataclass
class Run:
    """Figures of a run: fallen, closest [m], slip [m], offset of the centre of mass [m], Σ|Δτ| [Nm/s], statuses."""

    has_fallen: bool
    closest: float
    slip: float
    com: float
    jitter: float
    statuses: dict


def play(robot, controller, duration, at_step=None, label="", **plant):
    """Let a G1 wave while a ball crosses at 0.3 m/s; torques must be within limits, cones and finite in every step."""
    settings = PlantSettings(armature=0.01, friction=0.1, damping=0.1, **plant)
    body = TorquePlant(robot, robot.home, settings, [(frame, np.array(CORNERS)) for frame in FEET])
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, robot.home)
    hand = data.oMf[model.getFrameId(HAND)].translation.copy()
    com = pin.centerOfMass(model, data, robot.home).copy()
    torques, statuses, closest, slip, offset, has_fallen = [], {}, np.inf, 0.0, 0.0, False
    for k in range(round(duration / DT)):
        t, (q, v) = k * DT, body.measure()
        if at_step is not None:
            at_step(controller, t)
        targets = {HAND: wave(t, hand), "com": Sample.at(com)}
        tick = controller.tick(q, t, targets, {"ball": crossing(t)}, v)
        solution = tick.solution
        assert np.isfinite(solution.torque).all() and (np.abs(solution.torque) <= body.torque_limit + 1e-9).all()
        statuses[solution.status.value] = statuses.get(solution.status.value, 0) + 1
        closest = min(closest, tick.proximity.distance.min(initial=np.inf))
        body.apply(solution.torque, DT)
        torques.append(body.torque)
        slip = max(slip, float(body.slip().max()))
        offset = max(offset, float(np.linalg.norm((pin.centerOfMass(model, data, body.q) - com)[:2])))
        if body.q[2] < robot.home[2] - 0.3:
            has_fallen = True
            break
    jitter = float(np.abs(np.diff(torques, axis=0)).sum() / duration)
    run = Run(has_fallen, closest, slip, offset, jitter, statuses)
    lengths = f"closest {1e3 * closest:.1f}, slip {1e3 * slip:.2f}, com {1e3 * offset:.0f} mm"
    print(f"\n{label}: {lengths}, {jitter:.0f} Nm/s, {statuses}")
    return run


@pytest.fixture(scope="module")
def controller(g1):
    return make_controller(g1)


@pytest.mark.parametrize("solver", ["qp", "hqp"])
def test_torques_and_forces_obey_the_equations_of_motion(g1, controller, solver):
    """τ = rnea(q, v, a) - Jcᵀ f to 1e-9, nothing drives the base, forces lie in their cones, SOLVED."""
    model, rng = g1.model.copy(), np.random.default_rng(0)
    model.armature = np.concatenate((np.zeros(6), np.full(29, 0.01)))
    data, solved = model.createData(), 0
    controller = controller if solver == "qp" else make_controller(g1, solver, priorities=(1, 2))
    for _ in range(5):
        q = pin.integrate(model, g1.home, np.concatenate((np.zeros(6), rng.normal(scale=0.01, size=29))))
        v = rng.normal(scale=0.02, size=35)
        controller.reset(v)
        solution = controller.step(q, 0.0, v=v)
        torque = np.array(pin.rnea(model, data, q, v, solution.acceleration))
        for frame, forces in solution.forces.items():
            pin.framesForwardKinematics(model, data, q)
            i = model.getFrameId(frame)
            pose, J = data.oMf[i], pin.computeFrameJacobian(model, data, q, i, pin.LOCAL_WORLD_ALIGNED)
            for corner, force in zip(CORNERS, forces, strict=True):
                r = pose.rotation @ corner
                torque -= J[:3].T @ force + J[3:].T @ np.cross(r, force)
            along = forces @ pose.rotation[:, 2]
            if solution.status is Status.SOLVED:
                across = np.linalg.norm(forces - along[:, None] * pose.rotation[:, 2], axis=1)
                assert (across <= 0.5 * along + 1e-3).all() and (along >= 2.0 - 1e-2).all()
        solved += solution.status is Status.SOLVED
        np.testing.assert_allclose(torque[:6], 0.0, atol=1e-7)
        np.testing.assert_allclose(torque[6:], solution.torque, atol=1e-9)
        np.testing.assert_allclose(solution.v, v + DT * solution.acceleration, atol=1e-12)
    assert solved == 5


def test_the_compiled_step_is_the_one_of_the_problem(g1, controller):
    """The step in one call, against the problem in all velocities and impulses with daqp, where rows bind or do not."""
    general, rng, distance, solved = make_controller(g1, "qp:daqp"), np.random.default_rng(1), [], 0
    model, data = g1.model, g1.model.createData()
    for _ in range(16):
        q = pin.integrate(model, g1.home, np.concatenate((np.zeros(6), rng.normal(scale=0.01, size=29))))
        pin.framesForwardKinematics(model, data, q)
        hand = data.oMf[model.getFrameId(HAND)].translation
        ball = {"ball": Sample.at(hand + np.array([0.148, 0.0, rng.uniform(-0.05, 0.05)]), linear=[-0.2, 0.0, 0.0])}
        target, v = {HAND: Sample.at(hand + rng.normal(scale=0.1, size=3))}, rng.normal(scale=0.01, size=35)
        answers = []
        for each in (controller, general):
            each.reset(v)
            answers.append(each.step(q, 0.0, target, ball, v))
        one, other = answers
        assert one.status is other.status
        if one.status is Status.SOLVED:
            np.testing.assert_allclose(one.v, other.v, rtol=0, atol=1e-8)
            np.testing.assert_allclose(one.torque, other.torque, rtol=0, atol=1e-3)
            for frame in FEET:
                np.testing.assert_allclose(one.forces[frame], other.forces[frame], rtol=0, atol=1e-2)
            solved += 1
        problem = general.rows(q, obstacles=ball, v=v)
        distance.append(float((problem.avoidance.J @ one.v - problem.avoidance.b).min()))
    assert solved > 8 and min(distance) < 1e-6


@pytest.mark.parametrize("solver", ["qp", "hqp"])
def test_limits_of_torque_hold_in_every_priority(g1, solver):
    """A hand that is asked for more than motors give: some are at their limits, none beyond, contacts are held."""
    controller = make_controller(g1, solver, priorities=(1, 2), torque_limits=0.1, tracking_rate=1000.0)
    limit, at_limit = 0.1 * g1.model.effortLimit[6:], 0
    for seed in range(6):
        controller.reset()
        target = np.random.default_rng(seed).uniform(-1.0, 1.0, 3)
        solution = controller.step(g1.home, 0.0, {HAND: target}, v=np.zeros(35))
        assert (np.abs(solution.torque) <= limit + 1e-9).all()
        at_limit += solution.status is Status.SOLVED and bool((np.abs(solution.torque) > 0.99 * limit).any())
    assert at_limit > 2


def test_it_stands(g1, controller):
    controller.reset()
    run = play(g1, controller, 0.12)
    assert not run.has_fallen and run.slip < 1e-3 and set(run.statuses) == {"SOLVED"}


def test_torques_that_cannot_hold_it_are_a_stop_that_says_so(g1):
    controller = make_controller(g1, contacts=make_contacts(g1, force=(100.0, 1000.0)), torque_limits=0.05)
    solution = controller.step(g1.home, 0.0, v=np.zeros(35))
    assert solution.status is Status.STOPPED and np.isfinite(solution.torque).all()
    assert "CONTACTS_INFEASIBLE" in {reason.kind.value for reason in solution.reasons}


def test_what_does_not_go_together_is_named(g1, panda):
    flat = build_contacts([Contact(frame=frame) for frame in FEET], g1, g1.home)
    with pytest.raises(ConfigError, match="vertices"):
        make_controller(g1, contacts=flat)
    with pytest.raises(ConfigError, match="observer"):
        make_controller(g1, observer=Observer())
    with pytest.raises(ConfigError, match="contacts"):
        Controller(build_scene(g1), [], dynamics=Dynamics(), dt=DT)
    hand = build_contacts([Contact(frame="panda_hand", type="point")], panda, panda.home)
    with pytest.raises(ConfigError, match="panda"):
        Controller(build_scene(panda), [], dynamics=Dynamics(), contacts=hand, dt=DT)


def test_a_contact_that_leaves_bears_less_until_it_is_free(g1, controller):
    """Weight goes over to the other foot within the duration; then the foot has no force any more."""
    controller.reset()
    with pytest.raises(UnknownName, match="left_ankle_roll_link"):
        controller.set_contacts(["left_ankle_rol_link"])
    controller.set_contacts([FEET[1]], 0.02)
    most = []
    for k in range(22):
        solution = controller.step(g1.home, k * DT, v=np.zeros(35))
        most.append(solution.forces[FEET[0]][:, 2].max() if FEET[0] in (solution.forces or {}) else 0.0)
    assert most[0] > 20.0 and most[-1] == 0.0
    controller.set_contacts(FEET, 0.0)
    controller.step(g1.home, 23 * DT, v=np.zeros(35))
    assert controller.step(g1.home, 24 * DT, v=np.zeros(35)).forces[FEET[0]][:, 2].max() > 20.0


def test_a_law_that_holds_no_contacts_stands_too(g1):
    """Eq. 10 on motions that move no contact: torques within their limits, feet at rest, forces that carry it."""
    controller = make_controller(g1, "eq10")
    run = play(g1, controller, 0.05)
    assert not run.has_fallen and run.slip < 1e-3 and set(run.statuses) == {"SOLVED"}


@pytest.mark.slow
def test_a_ball_crosses_the_waving_hand(g1, controller):
    controller.reset()
    run = play(g1, controller, 10.0, label="10 s")
    assert not run.has_fallen and run.closest >= 0.0145 and run.slip < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("mass_scale", [0.8, 1.2])
def test_masses_that_are_off(g1, controller, mass_scale):
    controller.reset()
    run = play(g1, controller, 4.0, label=f"masses {mass_scale}", mass_scale=mass_scale)
    assert not run.has_fallen and run.closest >= 0.0145 and run.slip < 1e-3


@pytest.mark.slow
def test_a_slippery_floor(g1):
    run = play(g1, make_controller(g1, friction=0.25), 4.0, label="floor 0.3", floor_friction=0.3)
    assert not run.has_fallen and run.closest >= 0.0145 and run.slip < 1e-3


@pytest.mark.slow
def test_a_push(g1, controller):
    controller.reset()
    push = Push(frame="pelvis", force=(0.0, 60.0, 0.0), start=3.2)
    run = play(g1, controller, 4.0, label="60 N", pushes=[push])
    assert not run.has_fallen and run.closest >= 0.0145 and run.slip < 3e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("label", "plant"),
    [
        ("exact", {}), ("lighter", {"mass_scale": 0.8}), ("heavier", {"mass_scale": 1.2}),
        ("floor", {"floor_friction": 0.3}),
        ("push", {"pushes": [Push(frame="pelvis", force=(0.0, 60.0, 0.0), start=3.2)]}),
    ],
)  # fmt: skip
def test_the_scenario_that_ships(label, plant):
    """With its own weights, for its 10 s: no foot slips by 1 mm, pushed by 3 mm, and no step is a stop."""
    log = simulate(load_scenario("g1_wave"), plant=PlantSettings(armature=0.01, friction=0.1, damping=0.1, **plant))
    closest, figures = float(log.body_distance[:, 1:].min()), log.metrics()
    slip = figures["torque"]["slip"]
    print(f"\n{label}: closest {1e3 * closest:.1f}, slip {1e3 * slip:.2f} mm, {figures['status_counts']}")
    assert log.meta["completed"] and closest >= 0.0145 and slip < (3e-3 if label == "push" else 1e-3)
    assert figures["status_counts"]["STOPPED"] == 0 and abs(log.q[-1, 2] - log.q[0, 2]) < 0.05


@pytest.mark.slow
def test_motors_that_are_late(g1, controller):
    controller.reset()
    run = play(g1, controller, 4.0, label="2 ms late", delay=0.002)
    assert not run.has_fallen and run.closest >= 0.014 and run.jitter < 1000.0


@pytest.mark.slow
def test_too_little_torque(g1):
    """It may fall, but says so, with finite torques."""
    run = play(g1, make_controller(g1, torque_limits=0.12), 4.0, label="12 % of the torques")
    assert run.statuses.get("STOPPED", 0) + run.statuses.get("RELAXED", 0) > 0
    assert not run.has_fallen or run.statuses.get("STOPPED", 0) > 0
