"""Backup trajectories: one is kept while obstacles move, and followed where the task would leave none."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import SHIPPED, Ruler, cartesian, changed, make_controller

from qpavoid import Avoidance, Controller, Limits, Obstacle, ReasonKind, Sample, Status, load_scenario
from qpavoid.config import Box, Circle, Line, Sphere
from qpavoid.model.trajectory import build_motion
from qpavoid.safety.rollout import BackupRollouts
from qpavoid_bench.arena.families import load_family, make_case

DT = 0.01
GAP = 0.5
"""Radius of the two balls that close in [m]."""
KEPT = 0.5 * 0.02
"""Half of the safety distance, which a backup trajectory keeps [m]."""
TARGET = {"y": Sample.at([0.0, 0.0, 0.0])}


def on_line(name, shape, start, end, speed):
    """An obstacle on its way along a line."""
    return Obstacle(name, shape, build_motion(Line(start=start, end=end, speed=speed), None, SHIPPED.parent), True)


def closing_balls(speed=0.3):
    """Two large balls that come from both sides until they touch, where the robot stands."""
    sides = (("left", 1.0), ("right", -1.0))
    return [on_line(name, Sphere(radius=GAP), (0, 1.3 * s, 0), (0, GAP * s, 0), speed) for name, s in sides]


def controller_of(folder, obstacles, axes="xy", speed=0.25, acceleration=None, backup=True, **fields):
    """A ball of 5 cm on slides."""
    robot = cartesian(folder, axes, speed=speed, acceleration=acceleration)
    return make_controller(robot, obstacles, axes[-1], avoidance=Avoidance(d1=0.02, d2=0.1, backup=backup), **fields)


def loop(controller, steps, start=0, clock=lambda k: k * DT, external=False, step=None):
    """Yield (q, solution) of each control step of a loop that follows every velocity; the target is the origin."""
    q = controller.scene.robot.home.copy()
    for k in range(start, start + steps):
        t = clock(k)
        updates = {o.name: o.motion.sample(t) for o in controller.scene.obstacles} if external else None
        solution = step(q, t) if step else controller.step(q, t, TARGET, updates)
        yield q, solution
        q = pin.integrate(controller.scene.robot.model, q, controller.dt * solution.v)


def gaps(controller, states):
    """Least distance of the closing balls in each state (N,)."""
    centers = [[o.motion.sample(k * controller.dt).position[:2] for o in controller.scene.obstacles] for k in states]
    return np.array(
        [min(np.linalg.norm(q - c) for c in at) - GAP - 0.05 for q, at in zip(states.values(), centers, strict=True)]
    )


@pytest.fixture
def evaluations(monkeypatch):
    """Poses of rollouts that are evaluated, a one each."""
    calls, resume = [], BackupRollouts.resume

    def counted(rollouts, poses):
        code = resume(rollouts, poses)
        calls.extend([1] * (poses - rollouts.poses_left))
        return code

    monkeypatch.setattr(BackupRollouts, "resume", counted)
    return calls


# --- obstacles that close in ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("acceleration", "external", "jerk"),
    [(None, True, None), (2.0, False, None), (2.0, False, 50.0), (2.0, False, 4.0)],
)
def test_backup_leaves_closing_obstacles_in_time_and_reports_it(tmp_path, acceleration, external, jerk):
    controller = controller_of(tmp_path, closing_balls(), acceleration=acceleration, limits=Limits(jerk=jerk))
    states, solutions = {}, []
    for k, (q, solution) in enumerate(loop(controller, 280, external=external)):
        states[k] = q
        solutions.append(solution)
    assert gaps(controller, states).min() > 0.5 * KEPT  # evaluated every 40 ms
    used = [k for k, s in enumerate(solutions) if any(reason.kind is ReasonKind.BACKUP for reason in s.reasons)]
    assert len(used) > 10 and all(solutions[k].status is Status.RELAXED for k in used)
    # beside balls that touch, a ball of 5 cm is clear at √(0.55² - 0.5²) m from there, which takes 0.92 s
    latest = (1.3 - GAP) / 0.3 - np.sqrt(0.55**2 - GAP**2) / 0.25
    assert latest - (1.0 if jerk else 0.5) < DT * used[0] < latest + 0.05  # jerk limits delay braking
    v = np.array([s.v for s in solutions])
    assert np.abs(v).max() <= 0.25 + 1e-9
    if acceleration:
        assert np.abs(np.diff(v, axis=0, prepend=0.0)).max() / DT <= acceleration + 1e-6


def test_a_step_does_bit_for_bit_what_a_tick_does(tmp_path):
    """A step takes short ways where a backup trajectory stays valid; a tick does not."""
    balls = [*closing_balls(), on_line("passing", Sphere(radius=0.2), (-1.5, 0.7, 0.0), (1.5, 0.7, 0.0), 0.6)]
    short, full = (controller_of(tmp_path, balls, acceleration=2.0) for _ in range(2))
    for k, (q, solution) in enumerate(loop(short, 280)):
        tick = full.tick(q, k * DT, TARGET)
        assert tick.solution.v.tobytes() == solution.v.tobytes() and tick.solution.reasons == solution.reasons


@pytest.mark.parametrize("filtered", [False, True])
def test_without_backup_they_trap_the_robot(tmp_path, filtered):
    """So does a command of rest, which is filtered; with a backup trajectory that is left in time, too."""
    for backup in (False, True) if filtered else (False,):
        controller = controller_of(tmp_path, closing_balls(), backup=backup)
        rest = (lambda q, t, c=controller: c.filter(q, np.zeros(2), t)) if filtered else None
        states = {k: q for k, (q, _) in enumerate(loop(controller, 300, step=rest))}
        assert (gaps(controller, states).min() < 0.0) == (not backup)


@pytest.mark.parametrize(("at", "rate"), [(0.5, 1.0), (0.8, 1.8)])
def test_an_obstacle_on_a_circle_is_evaded_though_only_samples_tell_of_it(tmp_path, at, rate):
    """A ball of 0.3 m comes round through the origin; predicted on straight lines, it touches: by 42 and 256 mm."""
    motion = Circle(center=(0, at, 0), radius=at, period=2 * np.pi / rate, normal=(0, 0, 1), start_direction=(0, 1, 0))
    ball = Obstacle("ball", Sphere(radius=0.3), build_motion(motion, None, SHIPPED.parent), True)
    controller = controller_of(tmp_path, [ball])
    states = loop(controller, 400, external=True)
    least = min(np.linalg.norm(q - ball.motion.sample(k * DT).position[:2]) for k, (q, _) in enumerate(states))
    assert least - 0.3 - 0.05 > 0.9 * KEPT


# --- a press with one exit -----------------------------------------------------------------------------------------


def press(plug=False):
    """A chamber 0.6 m wide, with a piston that comes down in it, and an exit: a neck 20 cm high low in one wall."""
    walls = [
        ("floor", (0.7, 0.1, 0.2), (0.0, -0.35, 0.0)),
        ("left", (0.1, 2.0, 0.2), (-0.35, 0.65, 0.0)),
        ("above", (0.05, 1.05, 0.2), (0.325, 0.475, 0.0)),
        ("below", (0.05, 0.75, 0.2), (0.325, -0.625, 0.0)),
        *([("plug", (0.05, 0.2, 0.2), (0.325, -0.15, 0.0))] if plug else []),
    ]
    piston = on_line("piston", Box(size=(0.58, 0.1, 0.2)), (0.0, 0.5, 0.0), (0.0, -0.4, 0.0), 0.3)
    return [*[Obstacle.at(name, Box(size=size), at) for name, size, at in walls], piston]


@pytest.mark.parametrize("backup", [False, True])
def test_search_finds_an_exit_that_leads_nearer_first(tmp_path, backup):
    """Keeping away from everything leads nowhere: in the neck walls are at 5 cm, in the chamber at 10."""
    controller = controller_of(tmp_path, press(), speed=0.4, backup=backup)
    ruler, least = Ruler(controller.scene), np.inf
    for k, (q, solution) in enumerate(loop(controller, 240)):
        least = min(least, ruler.least_between(q, solution.v, DT, k * DT, steps=2))
    assert (least < 0.0) == (not backup), least
    assert not backup or (q[0] > 0.3 and least > 0.9 * KEPT)


def test_every_step_has_an_outcome_where_nothing_stays_clear(tmp_path):
    controller = controller_of(tmp_path, press(plug=True), speed=0.4, dt=0.05)
    ruler, least = Ruler(controller.scene), np.inf
    for k, (q, solution) in enumerate(loop(controller, 60, clock=lambda k: 0.05 * k)):
        assert np.abs(solution.v).max() <= 0.4 + 1e-9
        least = min(least, ruler.least_between(q, solution.v, 0.05, 0.05 * k, steps=2))
    assert least < -0.02


# --- a contact that no trajectory avoids ---------------------------------------------------------------------------


def test_a_way_out_is_taken_though_the_solver_leads_elsewhere_by_now():
    """At 500 Hz, balls and bars on a Panda that rests: a candidate takes four steps, and contact is 0.28 s ahead."""
    scenario = make_case(load_family("adversarial"), 1224).scenario
    controller, q = Controller.from_scenario(scenario)
    scene, dt = controller.scene, scenario.dt
    ruler, moving = Ruler(scene), [(i, slot.motion) for i, slot in enumerate(scene.slots) if slot.moves]
    least = np.inf
    for k in range(150):
        q = q + dt * controller.step(q, k * dt).v
        least = min(least, ruler.distances(q, {i: motion.sample((k + 1) * dt) for i, motion in moving}).min())
    assert least > 0.0


def test_further_contacts_are_avoided_after_an_unavoidable_one(tmp_path):
    """A slide along y cannot avoid a wall that comes along x, but it can avoid the ball behind it."""
    wall = on_line("wall", Box(size=(0.02, 4.0, 0.4)), (0.6, 0, 0), (-1.0, 0, 0), 0.5)
    ball = on_line("ball", Sphere(radius=0.15), (-1.2, 0.02, 0), (1.0, 0.02, 0), 0.6)
    controller, walls, balls = controller_of(tmp_path, [wall, ball], axes="y", acceleration=4.0), [], []
    for k, (q, _) in enumerate(loop(controller, 280)):
        x = [o.motion.sample(k * DT).position[0] for o in (wall, ball)]
        walls.append(abs(x[0]) - 0.01 - 0.05)
        balls.append(np.hypot(x[1], q[0] - 0.02) - 0.15 - 0.05)
    assert min(walls) < 0.0 < 0.5 * KEPT < min(balls)


# --- an attached object --------------------------------------------------------------------------------------------


def test_an_attached_object_is_moved_out_of_the_way_too(tmp_path):
    """Balls that touch leave a bar of 0.6 m across the slides 0.44 m from there, not 0.23: it leaves earlier."""
    bar, firsts = Obstacle.at("bar", Box(size=(0.6, 0.04, 0.04)), [0.0, 0.0, 0.0], graspable=True), []
    for attached in (False, True):
        controller, least, used = controller_of(tmp_path, [*closing_balls(), bar][: 2 + attached]), np.inf, []
        if attached:
            controller.attach("bar", "y", np.zeros(2))
        for k, (q, solution) in enumerate(loop(controller, 260)):
            for ball in closing_balls():
                away = np.abs(ball.motion.sample(k * DT).position[:2] - q)
                edge = np.linalg.norm(np.maximum(away - [0.3, 0.02], 0.0)) if attached else np.inf
                least = min(least, np.linalg.norm(away) - 0.05 - GAP, edge - GAP)
            used += [k] if any(reason.kind is ReasonKind.BACKUP for reason in solution.reasons) else []
        assert least > 0.5 * KEPT
        firsts.append(used[0])
    assert DT * firsts[1] < DT * firsts[0] - 0.5


# --- bounded work --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dt", "poses"), [(0.01, 114), (0.002, 17)])
def test_work_of_a_step_is_bounded(tmp_path, evaluations, dt, poses):
    """So many poses, whatever is searched for; a trajectory takes 41 to 82."""
    controller, most = controller_of(tmp_path, press(), speed=0.4, dt=dt), 0
    evaluations.clear()
    for _ in loop(controller, round(2.0 / dt), clock=lambda k: dt * k):
        most, _ = max(most, len(evaluations)), evaluations.clear()
    assert 0.4 * poses < most <= poses


def test_an_obstacle_that_appears_near_is_evaded_within_the_same_bound(tmp_path, evaluations):
    """A ball is given for the first time 1 m off, at 1 m/s; there is 0.85 s to go aside by 0.17 m, at 0.25 m/s."""
    dt, ball = 0.002, Obstacle.at("ball", Sphere(radius=0.1), [9.0, 0.0, 0.0])
    controller, q, least = controller_of(tmp_path, [ball], dt=dt), np.zeros(2), np.inf
    evaluations.clear()
    for k in range(900):
        center = np.array([1.0 - dt * (k - 100), 0.01, 0.0])
        updates = {"ball": Sample.at(center, linear=[-1.0, 0.0, 0.0])} if k >= 100 else None
        solution = controller.step(q, dt * k, TARGET, updates)
        assert len(evaluations) <= 17
        assert k > 100 or solution.status is Status.SOLVED  # until a backup trajectory is known, the task goes on
        evaluations.clear()
        q = q + dt * solution.v
        least = min(least, np.linalg.norm(q - center[:2]) - 0.15) if k >= 100 else least
    assert least > KEPT


def test_a_search_over_several_steps_leaves_in_time(tmp_path, evaluations):
    """A candidate takes five control steps of a millisecond; the robot stays at its task while that is safe."""
    controller = controller_of(tmp_path, closing_balls(), acceleration=2.0, dt=0.001)
    states, q = {}, np.array([0.0, 0.0])
    evaluations.clear()
    for k in range(2800):
        states[k] = q
        q = q + 0.001 * controller.step(q, k * 0.001, TARGET).v
        assert len(evaluations) <= 10
        evaluations.clear()
    assert gaps(controller, states).min() > 0.5 * KEPT
    assert np.abs([states[k][0] for k in range(500)]).max() < 1e-3


def test_no_rollout_while_moving_obstacles_stay_far(tmp_path, evaluations):
    """Bounding spheres are compared every 0.1 s, over 1.5 s, with the distance from which on nothing is parted."""
    far = on_line("far", Sphere(radius=0.1), (0.0, 3.0, 0.0), (0.0, 0.0, 0.0), 0.3)
    controller = controller_of(tmp_path, [far])
    evaluations.clear()
    k = next(k for k in range(0, 900, 10) if controller.step(np.zeros(2), k * DT, TARGET) and evaluations)
    near = 3.0 - 0.15 - 0.3 * (k * DT + 1.51)  # its distance a step and 1.5 s later
    assert near - 0.015 - 0.03 < 0.1 < near - 0.015 + 0.03


# --- where there is none -------------------------------------------------------------------------------------------


def test_backup_is_bitwise_neutral_among_static_obstacles():
    base = load_scenario("ur5_pole")
    assert all(o.motion.type == "fixed" for o in base.obstacles)
    without = base.model_copy(update={"avoidance": base.avoidance.model_copy(update={"backup": False})})
    (one, q), (two, _) = Controller.from_scenario(base), Controller.from_scenario(without.with_source(base.source))
    for k in range(100):
        v = one.step(q, k * base.dt).v
        assert np.array_equal(v, two.step(q, k * base.dt).v)
        q = pin.integrate(one.scene.robot.model, q, v * base.dt)


def test_missing_backup_with_contacts_is_an_assumption_where_obstacles_move(evaluations):
    for moves in (False, True):
        ball = {"type": "line", "start": [1, 1, 1], "end": [1, -1, 1], "speed": 0.1}
        ball = ball if moves else {"type": "fixed", "position": [1, 1, 1]}
        shape = {"type": "sphere", "radius": 0.1}
        scenario = changed("humanoid_reach", obstacles=[{"name": "ball", "shape": shape, "motion": ball}])
        assert scenario.contacts and scenario.avoidance.backup
        controller, q = Controller.from_scenario(scenario)
        kinds = [reason.kind for reason in controller.step(q).assumptions]
        assert (ReasonKind.NO_BACKUP in kinds) == moves and not evaluations


def test_backup_applies_to_bounded_solvers_only(tmp_path, evaluations):
    """The velocity of a law of the paper is commanded as it is, so that it can be compared."""
    for solver, applies in (("eq10", False), ("qp", True)):
        controller = controller_of(tmp_path, closing_balls(), solver=solver)
        evaluations.clear()
        controller.step(np.zeros(2), 2.5, TARGET)
        assert bool(evaluations) == applies
