"""Backup trajectories: one is kept while obstacles move, and followed where the task would leave none."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import SHIPPED, Ruler, cartesian, changed, make_controller
from hypothesis import given, settings
from hypothesis import strategies as st
from qpavoid.safety.policy import BackupPolicy, ContactAccumulator, Near, Start

from qpavoid import Controller, Obstacle, Pose, ReasonKind, Sample, ScenarioConfig, Status, kernels, load_scenario
from qpavoid.config import Avoidance, Backup, Box, Limits, Line, Sensing, Sphere
from qpavoid.control.estimates import prediction_error_bound
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.trajectories import extrapolate
from qpavoid.model.trajectory import build_motion
from qpavoid.safety.rollout import _farthest
from qpavoid.solvers.backends import solve_daqp

DT = 0.01
GAP = 0.5
"""Radius of the two balls that close in [m]."""


def closing_balls(stop=GAP, speed=0.3):
    """Two large balls that come from both sides until they touch, where the robot stands."""
    balls = []
    for name, side in (("left", 1.0), ("right", -1.0)):
        line = Line(start=(0.0, 1.3 * side, 0.0), end=(0.0, stop * side, 0.0), speed=speed)
        balls.append(Obstacle(name, Sphere(radius=GAP), build_motion(line, None, SHIPPED.parent), moves=True))
    return balls


def backup_of(controller):
    """The backup planner of a controller."""
    return controller._arbiter.backup


def count_rollouts(controller, record):
    """Calls `record` with the start time of every rollout of a controller."""
    rollouts = backup_of(controller).rollouts
    rollout = rollouts.rollout
    rollouts.rollout = lambda start, *args: record(start.t) or rollout(start, *args)


def run_between_closing_balls(folder, backup, acceleration=None, external=False, jerk=None):
    """A ball on slides whose target is where the balls meet in 2.7 s; distances at every step, and the solutions."""
    robot = cartesian(folder, "xy", speed=0.25, acceleration=acceleration)
    avoidance = Avoidance(d1=0.02, d2=0.10, backup=backup)
    controller = make_controller(robot, closing_balls(), "y", avoidance=avoidance, limits=Limits(jerk=jerk))
    q, gaps, solutions = robot.home.copy(), [], []
    for k in range(280):
        t = k * DT
        centers = [obstacle.motion.sample(t).position[:2] for obstacle in controller.scene.obstacles]
        gaps.append(min(np.linalg.norm(q - center) for center in centers) - GAP - 0.05)
        updates = {o.name: o.motion.sample(t) for o in controller.scene.obstacles} if external else None
        solutions.append(controller.step(q, t, {"y": Sample.at([0.0, 0.0, 0.0])}, updates))
        q = pin.integrate(robot.model, q, DT * solutions[-1].v)
    return np.array(gaps), solutions


def test_without_backup_qp_is_trapped_by_closing_obstacles(tmp_path):
    gaps, _ = run_between_closing_balls(tmp_path, None)
    assert gaps.min() < -0.01


@pytest.mark.parametrize(
    ("acceleration", "external", "jerk"),
    [(None, True, None), (2.0, False, None), (2.0, False, 50.0), (2.0, False, 4.0)],
)
def test_backup_leaves_closing_obstacles_in_time_and_reports_it(tmp_path, acceleration, external, jerk):
    gaps, solutions = run_between_closing_balls(tmp_path, Backup(), acceleration, external, jerk)
    assert gaps.min() > 0.5 * Backup().distance_scale * 0.02  # evaluated every 40 ms
    backups = [s for s in solutions if any(reason.kind is ReasonKind.BACKUP for reason in s.reasons)]
    assert len(backups) > 10 and all(s.status is Status.RELAXED for s in backups)
    # beside balls that touch, a ball of 5 cm is clear at √(0.55² - 0.5²) m from there, which takes 0.92 s
    latest = (1.3 - GAP) / 0.3 - np.sqrt(0.55**2 - GAP**2) / 0.25
    first = next(k for k, solution in enumerate(solutions) if solution is backups[0])
    assert latest - (1.0 if jerk else 0.5) < DT * first < latest + 0.05  # jerk limits delay braking
    v = np.array([s.v for s in solutions])
    assert np.abs(v).max() <= 0.25 + 1e-9
    if acceleration:
        change = np.diff(v, axis=0, prepend=0.0) / DT
        assert np.abs(change).max() <= acceleration + 1e-6


def test_backup_decisions_hold_for_10_ms_in_short_control_periods(tmp_path):
    """A ball on slides whose target is where two balls meet leaves in time, with a decision in ten steps at most."""
    dt, robot = 0.001, cartesian(tmp_path, "xy", speed=0.25, acceleration=2.0)
    controller = make_controller(robot, closing_balls(), "y", dt=dt, avoidance=Avoidance(d1=0.02, d2=0.10))
    decisions = []
    count_rollouts(controller, lambda _: decisions.append(k))
    q, least, far = robot.home.copy(), np.inf, 0.0
    for k in range(2800):
        centers = [obstacle.motion.sample(k * dt).position[:2] for obstacle in controller.scene.obstacles]
        least = min(least, *(np.linalg.norm(q - center) - GAP - 0.05 for center in centers))
        q = pin.integrate(robot.model, q, dt * controller.step(q, k * dt, {"y": Sample.at([0.0, 0.0, 0.0])}).v)
        far = max(far, abs(q[0]) if k < 500 else 0.0)
    assert least > 0.5 * Backup().distance_scale * 0.02
    assert far < 1e-3  # it stays at its task while that is safe
    steps = np.unique(decisions)
    assert len(steps) > 5 and np.diff(steps).min() >= 10


def test_rollout_begins_with_its_prefix(among_balls):
    _, planner, q = among_balls
    planner.reset()
    v = np.full(len(q), 0.02)
    for steps in (1, 3, 4, 9):
        trajectory = planner.rollouts.simulate(
            start_of(planner, q, 0.02), planner.rollouts.stop_policy, np.tile(v, (steps, 1))
        )
        assert len(trajectory.v) >= 150
        ramp = planner.rollouts.ramps.follow(np.zeros(len(q)), np.zeros(len(q)), np.tile(v, (steps, 1)))
        np.testing.assert_allclose(trajectory.v[:steps], ramp, rtol=0, atol=1e-12)
        assert np.abs(trajectory.v[steps]).max() < 0.02 - 1e-4  # it changes by 0.03 rad/s per step at least


def test_backup_is_bitwise_neutral_among_static_obstacles():
    base = load_scenario("ur5_pole", ["duration=3"])
    assert all(o.motion.type == "fixed" for o in base.obstacles)
    without = base.model_copy(update={"avoidance": base.avoidance.model_copy(update={"backup": None})})
    (one, q), (two, _) = Controller.from_scenario(base), Controller.from_scenario(without.with_source(base.source))
    for k in range(300):
        v = one.step(q, k * base.dt).v
        assert np.array_equal(v, two.step(q, k * base.dt).v)
        q = pin.integrate(one.scene.robot.model, q, v * base.dt)


def test_backup_applies_to_filtered_velocities(tmp_path):
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    for backup, trapped in ((None, True), (Backup(), False)):
        controller = make_controller(robot, closing_balls(), avoidance=Avoidance(d1=0.02, d2=0.10, backup=backup))
        q, least = robot.home.copy(), np.inf
        for k in range(300):
            solution = controller.filter(q, np.zeros(2), k * DT)
            q = pin.integrate(robot.model, q, DT * solution.v)
            centers = [o.motion.sample((k + 1) * DT).position[:2] for o in controller.scene.obstacles]
            least = min(least, *(np.linalg.norm(q - center) - GAP - 0.05 for center in centers))
        assert (least < 0.0) == trapped


UNBIASED = BackupPolicy(1.0, np.zeros(4))
"""Horizon of 1 s, no bias velocity."""


def test_farthest_maximises_the_smallest_distance():
    from scipy.optimize import linprog

    rng = np.random.default_rng(0)
    for _ in range(50):
        A, d = 0.2 * rng.normal(size=(6, 4)), rng.uniform(0.0, 0.1, 6)
        lower, upper = -np.ones(4), np.ones(4)
        v = _farthest(Near(np.column_stack((d, np.zeros((6, 9)))), A, np.zeros(6)), UNBIASED, 10.0, lower, upper)
        best = linprog(
            [0, 0, 0, 0, -1], A_ub=np.column_stack((-A, np.ones(6))), b_ub=d, bounds=[(-1, 1)] * 4 + [(None, None)]
        )
        # the regularisation costs at most ε/2 ‖v‖² <= 2e-4 of ½ (10 - s)², whose slope is about 10
        assert v is not None and (A @ v + d).min() == pytest.approx(best.x[-1], abs=1e-4)


def test_farthest_agrees_with_daqp():
    """max s - ½ s²/c - ε/2c ‖v - v̂‖²  s.t.  d + h (J v + ḋ) >= s,  lower <= v <= upper, as one QP in (v, s)."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        closest, J, feedforward = rng.uniform(0.0, 0.1, (5, 10)), rng.normal(size=(5, 3)), 0.1 * rng.normal(size=5)
        h, preferred, effort, bias = 0.2, 0.1, 1e-4, rng.normal(size=3)
        v, converged = kernels.max_clearance_velocity(
            h, closest, J, feedforward, preferred, 10.0, effort, bias, -np.ones(3), np.ones(3)
        )
        P = np.diag([effort, effort, effort, 1.0])
        G, least = np.column_stack((h * J, -np.ones(5))), -(closest[:, 0] + h * feedforward)
        bounds = np.array([-1.0, -1.0, -1.0, -10.0]), np.array([1.0, 1.0, 1.0, preferred])
        expected = solve_daqp(P, -P @ np.append(bias, preferred), G, least, *bounds)
        assert converged and v == pytest.approx(expected[:3], abs=1e-6)


def test_missing_backup_with_contacts_is_an_assumption_where_obstacles_move():
    for moves in (False, True):
        ball = {"type": "line", "start": [1, 1, 1], "end": [1, -1, 1], "speed": 0.1}
        ball = ball if moves else {"type": "fixed", "position": [1, 1, 1]}
        scenario = changed(
            "humanoid_reach",
            obstacles=[{"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "motion": ball}],
        )
        assert scenario.contacts and scenario.avoidance.backup is not None
        controller, q = Controller.from_scenario(scenario)
        assert backup_of(controller) is None
        kinds = [reason.kind for reason in controller.step(q).assumptions]
        assert (ReasonKind.NO_BACKUP in kinds) == moves


def test_backup_applies_to_bounded_solvers_only(tmp_path):
    """The velocity of a law of the paper is commanded as it is, so that it can be compared."""
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    for solver, applies in (("eq10", False), ("qp", True)):
        controller = make_controller(robot, closing_balls(), "y", solver=solver, avoidance=Avoidance(d1=0.02, d2=0.10))
        times = []
        count_rollouts(controller, times.append)
        controller.step(robot.home, 2.5, {"y": Sample.at([0.0, 0.0, 0.0])})
        assert bool(times) == applies


def test_backup_settings_outside_their_limits_are_refused():
    fields = {"robot": "panda", "tasks": [{"frame": "panda_hand_tcp"}], "duration": 1.0}
    with pytest.raises(ValueError, match="horizon"):
        ScenarioConfig.model_validate({**fields, "avoidance": {"backup": {"horizon": 0.0}}})
    assert ScenarioConfig.model_validate(fields).avoidance.backup == Backup()
    assert ScenarioConfig.model_validate({**fields, "avoidance": {"backup": None}}).avoidance.backup is None


def slab(name, size, at, to=None, speed=0.3):
    """A box at rest, or on its way to somewhere else."""
    if to is None:
        return Obstacle.at(name, Box(size=size), at)
    return Obstacle(name, Box(size=size), build_motion(Line(start=at, end=to, speed=speed), None, SHIPPED.parent), True)


def chamber_with_piston():
    """A chamber 0.6 m wide, with a piston that comes down in it, and an exit: a neck 20 cm high low in one wall."""
    return [
        slab("floor", (0.7, 0.1, 0.2), (0.0, -0.35, 0.0)),
        slab("left", (0.1, 2.0, 0.2), (-0.35, 0.65, 0.0)),
        slab("above", (0.05, 1.05, 0.2), (0.325, 0.475, 0.0)),
        slab("below", (0.05, 0.75, 0.2), (0.325, -0.625, 0.0)),
        slab("piston", (0.58, 0.1, 0.2), (0.0, 0.5, 0.0), (0.0, -0.4, 0.0)),
    ]


def test_backup_search_finds_an_exit_that_leads_nearer_first(tmp_path):
    """Keeping away from everything leads nowhere: in the neck walls are at 5 cm, in the chamber at 10."""
    robot = cartesian(tmp_path, "xy", speed=0.4, acceleration=None)
    for backup, crushed in ((None, True), (Backup(), False)):
        controller = make_controller(
            robot, chamber_with_piston(), "y", avoidance=Avoidance(d1=0.02, d2=0.10, backup=backup)
        )
        ruler, q, least = Ruler(controller.scene), robot.home.copy(), np.inf
        for k in range(240):
            v = controller.step(q, k * DT, {"y": Sample.at([0.0, 0.0, 0.0])}).v
            least = min(least, ruler.least_between(q, v, DT, k * DT, steps=2))
            q = pin.integrate(robot.model, q, DT * v)
        assert (least < 0.0) == crushed, least
        assert crushed or (q[0] > 0.3 and least > 0.9 * Backup().distance_scale * 0.02)


def test_backup_avoids_further_contacts_after_an_unavoidable_one(tmp_path):
    """A slide along y cannot avoid a wall that comes along x, but it can avoid the ball behind it."""
    robot = cartesian(tmp_path, "y", speed=0.25)
    wall = Obstacle(
        "wall", Box(size=(0.02, 4.0, 0.4)),
        build_motion(Line(start=(0.6, 0, 0), end=(-1.0, 0, 0), speed=0.5), None, SHIPPED.parent), moves=True,
    )  # fmt: skip
    ball = Obstacle(
        "ball", Sphere(radius=0.15),
        build_motion(Line(start=(-1.2, 0.02, 0), end=(1.0, 0.02, 0), speed=0.6), None, SHIPPED.parent), moves=True,
    )  # fmt: skip
    controller = make_controller(robot, [wall, ball], "y", avoidance=Avoidance(d1=0.02, d2=0.10, backup=Backup()))
    q, walls, balls = robot.home.copy(), [], []
    for k in range(280):
        t = k * DT
        x = [o.motion.sample(t).position[0] for o in (wall, ball)]
        walls.append(abs(x[0]) - 0.01 - 0.05)
        balls.append(np.hypot(x[1], q[0] - 0.02) - 0.15 - 0.05)
        q = pin.integrate(robot.model, q, DT * controller.step(q, t, {"y": Sample.at([0.0, 0.0, 0.0])}).v)
    assert min(walls) < 0.0 < 0.5 * Backup().distance_scale * 0.02 < min(balls)


def test_every_step_has_an_outcome_without_any_clear_backup(tmp_path):
    robot = cartesian(tmp_path, "xy", speed=0.4, acceleration=None)
    closed, dt = [*chamber_with_piston(), slab("plug", (0.05, 0.2, 0.2), (0.325, -0.15, 0.0))], 0.05
    controller = make_controller(robot, closed, "y", dt=dt, avoidance=Avoidance(d1=0.02, d2=0.10, backup=Backup()))
    ruler, q, least = Ruler(controller.scene), robot.home.copy(), np.inf
    for k in range(60):
        v = controller.step(q, k * dt, {"y": Sample.at([0.0, 0.0, 0.0])}).v
        assert np.abs(v).max() <= 0.4 + 1e-9
        least = min(least, ruler.least_between(q, v, dt, k * dt, steps=2))
        q = pin.integrate(robot.model, q, dt * v)
    assert least < -0.02


def planner_of(scenario):
    """A planner, its controller, and the start of a run."""
    controller, q = Controller.from_scenario(scenario)
    planner = backup_of(controller)
    assert planner is not None
    return controller, planner, q


LIMITS = {"speeds": {}, "accelerations": {"acceleration": 3.0}, "jerks": {"acceleration": 3.0, "jerk": 60.0}}


@pytest.fixture(scope="module", params=LIMITS.values(), ids=LIMITS)
def among_balls(request):
    """A Panda among balls that cross its path."""
    balls = [
        {
            "name": f"ball{i}",
            "shape": {"type": "sphere", "radius": 0.08},
            "motion": {"type": "line", "start": start, "end": end, "speed": 0.3},
        }
        for i, (start, end) in enumerate(
            [
                ((0.9, 0.1, 0.5), (-0.9, 0.1, 0.5)),
                ((0.4, -0.8, 0.7), (0.4, 0.8, 0.4)),
                ((0.2, 0.7, 0.3), (0.2, -0.7, 0.3)),
            ]
        )
    ]
    avoidance = {"d1": 0.03, "d2": 0.1, "backup": {}}
    return planner_of(changed("panda_line", obstacles=balls, avoidance=avoidance, limits=request.param, dt=0.01))


def start_of(planner, q, t, v=None):
    return Start(q, np.zeros(len(q)) if v is None else v, np.zeros(len(q)), t, planner.rollouts.separable_pairs)


def largest_change(trajectory, times):
    """Of the velocities of a trajectory from step to step, or of that change itself."""
    before = [trajectory.start.v - trajectory.start.dv, trajectory.start.v]
    return np.abs(np.diff(np.vstack((before, trajectory.v)), times, axis=0)).max(initial=0.0)


def test_rollout_of_a_trajectory_and_of_its_remainder_reproduces_it(among_balls):
    _, planner, q = among_balls
    planner.reset()
    touched = 0
    for t in (0.02, 0.13, 0.51, 1.17):  # a step later, trajectories end at the same time
        for policy in [planner.rollouts.stop_policy, *(planner._sample_policy() for _ in range(5))]:
            planner.rollouts.drop_predictions()
            trajectory = planner.rollouts.simulate(start_of(planner, q, t), policy)
            again = planner.rollouts.simulate(trajectory.start, planner.rollouts.stop_policy, trajectory.v)
            assert again.score == pytest.approx(trajectory.score, abs=1e-12)
            np.testing.assert_allclose(again.v, trajectory.v, rtol=0, atol=1e-12)
            assert largest_change(trajectory, 2) <= planner.rollouts.ramps.limits.dv_step.max() * (1.0 + 1e-9)
            assert largest_change(trajectory, 1) <= planner.rollouts.ramps.limits.v_step.max() * (1.0 + 1e-9)
            touched += trajectory.score.time_to_contact < 1.5
            remainder = planner.rollouts.advance(trajectory)
            later = planner.rollouts.simulate(remainder.start, policy, remainder.v)
            assert later.contact_time == pytest.approx(trajectory.contact_time, abs=1e-9)
            assert later.clearance >= trajectory.clearance - 1e-9
    assert 0 < touched < 24


def test_rollout_ends_early_exactly_when_it_does_not_beat_another(among_balls):
    _, planner, q = among_balls
    planner.reset()
    best, counts = None, {True: 0, False: 0}
    for t in (0.13, 0.51, 1.17):
        start, best = start_of(planner, q, t), None
        for _ in range(8):
            policy = planner._sample_policy()
            alone = planner.rollouts.simulate(start, policy)
            beats = best is None or alone.score > best.score
            found = planner.rollouts.rollout(start, policy, None, best)
            assert (found is not None) == beats
            if found is not None:
                assert found.score == alone.score
            counts[beats] += 1
            best = found or best
    assert min(counts.values()) > 2


def test_validity_from_a_nearby_start_is_conservative(among_balls):
    """Against a rollout from that start."""
    _, planner, q = among_balls
    planner.reset()
    rng, valid = np.random.default_rng(2), 0
    for _ in range(60):
        t = rng.uniform(0.0, 2.0)
        planner.rollouts.drop_predictions()
        trajectory = planner.rollouts.simulate(start_of(planner, q, t), planner._sample_policy())
        off = rng.uniform(-1.0, 1.0, len(q)) * 10.0 ** rng.uniform(-4.0, -1.5)
        start = start_of(planner, pin.integrate(planner._model, q, off), t, rng.uniform(-0.05, 0.05, len(q)))
        if planner.rollouts.is_valid_from(trajectory, start):
            valid += 1
            again = planner.rollouts.simulate(start, planner.rollouts.stop_policy, trajectory.v)
            assert again.score >= planner.rollouts.sufficient_score
            assert again.clearance >= trajectory.clearance - planner.rollouts.lever_arm * 0.1 * len(q)
    assert 2 < valid < 55


def test_rollout_detects_a_plate_passed_between_two_decisions(tmp_path):
    """A ball of 10 cm at 3 m/s passes a plate of 2 mm within 34 ms; rollouts decide every 40 ms."""
    robot = cartesian(tmp_path, "xy", speed=3.0, acceleration=None)
    plate = slab("plate", (0.002, 2.0, 0.2), (0.001, 0.0, 0.0))
    for shift in np.linspace(0.0, 0.12, 7):
        controller = make_controller(
            robot, [plate, *closing_balls()], "y", avoidance=Avoidance(d1=0.02, d2=0.1, backup=Backup())
        )
        planner = backup_of(controller)
        q = np.array([-0.5 - shift, 0.0])
        start = start_of(planner, q, 0.0)
        trajectory = planner.rollouts.simulate(start, planner.rollouts.stop_policy, np.tile([3.0, 0.0], (40, 1)))
        contact = (0.45 + shift) / 3.0
        assert trajectory.contact_time == pytest.approx(contact, abs=0.04), shift


def test_backup_is_verified_anew_when_obstacles_turn(tmp_path):
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    chaser = Obstacle.at("chaser", Sphere(radius=0.1), [-0.4, 0.0, 0.0])
    avoidance = Avoidance(d1=0.02, d2=0.1, backup=Backup(candidates=20))
    controller = make_controller(robot, [chaser], "y", avoidance=avoidance)
    planner = backup_of(controller)

    def update(speed):
        return {"chaser": Sample.at([-0.4, 0.0, 0.0], linear=[speed, 0.0, 0.0])}

    start = Start(robot.home, np.zeros(2), np.zeros(2), 0.0, planner.rollouts.separable_pairs)
    for speed, clear in ((0.0, 1.5), (0.5, 0.25 / 0.5)):
        for k in range(200):  # the prediction is of the mean twist
            controller._builder.tracker.advance(controller._builder.tracker.read(0.01 * (k - 199), update(speed)))
        planner.rollouts.drop_predictions()
        found, _ = planner._current_backup(start)
        if speed == 0.0:
            planner._backup = found
            assert np.abs(found.v).max() < 1e-9
        kept = planner.rollouts.simulate(start, planner.rollouts.stop_policy, planner._backup.v)
        assert kept.score.time_to_contact == pytest.approx(clear, abs=0.005)
        assert (
            found.score >= planner.rollouts.sufficient_score
        )  # aside, at less than 0.25 m/s: 0.21 m in 0.4 m / (0.5 m/s)
        again = planner.rollouts.simulate(start, planner.rollouts.stop_policy, found.v)
        assert again.score == pytest.approx(found.score, abs=1e-9)


def test_predicted_states_of_the_past_are_dropped(among_balls):
    controller, planner, q = among_balls
    controller.reset()
    most = 0
    for k in range(400):
        q = pin.integrate(planner._model, q, DT * controller.step(q, k * DT).v)
        most = max(most, len(planner.rollouts._predictions))
    assert 100 < most < 1000  # a step with many rollouts predicts some hundreds
    for t, predicted in planner.rollouts._predictions.items():
        np.testing.assert_array_equal(predicted.states, controller._builder.tracker.at(t).states)


def test_no_rollout_while_moving_obstacles_stay_far(tmp_path):
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    far = [
        Obstacle(
            "far", Sphere(radius=0.1), build_motion(Line(start=(0.0, 3.0, 0.0), end=(0.0, 0.0, 0.0), speed=0.3)), True
        )
    ]
    controller = make_controller(robot, far, "y", avoidance=Avoidance(d1=0.02, d2=0.1, backup=Backup()))
    times = []
    count_rollouts(controller, times.append)
    q = robot.home.copy()
    for k in range(0, 900, 10):
        controller.step(q, k * DT, {"y": Sample.at([0.0, 0.0, 0.0])})
        if times:
            break
    near = 3.0 - 0.15 - 0.3 * (k * DT + 1.51)  # its distance a step and 1.5 s later
    assert (
        near - 0.015 - 0.03 < 0.1 < near - 0.015 + 0.03
    )  # evaluated every 0.1 s, up to the first such time after that


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-1.5, 1.5)] * 6, st.floats(0.05, 0.5)), min_size=1, max_size=4),
    st.floats(0.0, 1.0),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_far_obstacle_check_is_conservative(tmp_path_factory, lines, t, v):
    robot = ROBOTS.setdefault("xy", cartesian(tmp_path_factory.mktemp("robot"), "xy", speed=1.0, acceleration=2.0))
    obstacles = [
        Obstacle(f"o{i}", Sphere(radius=0.1), build_motion(Line(start=line[:3], end=line[3:6], speed=line[6])), True)
        for i, line in enumerate(lines)
        if np.linalg.norm(np.subtract(line[:3], line[3:6])) > 1e-3
    ]
    if not obstacles:
        return
    controller = make_controller(robot, obstacles, avoidance=Avoidance(d1=0.02, d2=0.1, backup=Backup()))
    planner, v = backup_of(controller), np.array(v)
    for k, away in enumerate((0.0, 0.01, 0.1, 0.3)):  # a cached clearance counts for configurations near by
        home, at = robot.home + away, t + 0.02 * k
        moving = [o for o in obstacles if o.motion.sample(at).linear.any()]  # those at rest do not count
        if not planner._moving_obstacles_stay_far(Start(home, v, np.zeros(2), at, planner.rollouts.separable_pairs)):
            continue
        for later in np.linspace(0.0, 1.5, 76):
            braking = np.minimum(later, np.abs(v) / 2.0)
            q = home + np.sign(v) * (np.abs(v) * braking - braking**2)
            place = np.array([*q, 0.0])
            centers = [o.motion.sample(at + later).position for o in moving]
            assert min((np.linalg.norm(place - center) for center in centers), default=1.0) - 0.15 > 0.1


ROBOTS = {}
"""Robots that are built once."""


def test_backup_validity_ends_with_time_pairs_and_attachments(tmp_path, among_balls):
    _, planner, q = among_balls
    planner.reset()
    planner.rollouts.drop_predictions()
    trajectory = next(
        f
        for f in iter(lambda: planner.rollouts.simulate(start_of(planner, q, 0.0), planner._sample_policy()), None)
        if f.score >= planner.rollouts.sufficient_score
    )
    assert planner.rollouts.is_valid_from(trajectory, trajectory.start)
    assert not planner.rollouts.is_valid_from(
        trajectory, trajectory.start._replace(t=0.02)
    )  # obstacles are elsewhere by then
    late = trajectory.start._replace(t=0.008)
    margin = trajectory.clearance - planner.rollouts.sufficient_score.clearance
    assert planner.rollouts.is_valid_from(trajectory, late, 0.99 * margin / 0.008)
    assert not planner.rollouts.is_valid_from(trajectory, late, 1.01 * margin / 0.008)
    assert not planner.rollouts.is_valid_from(
        trajectory, trajectory.start._replace(enabled=~planner.rollouts.separable_pairs)
    )
    load = Obstacle.at("load", Sphere(radius=0.02), [0.3, 0.0, 0.0], graspable=True)
    ball = Obstacle(
        "ball", Sphere(radius=0.1), build_motion(Line(start=(0.0, 0.6, 0.0), end=(0.0, -2.0, 0.0), speed=0.01)), True
    )
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    controller = make_controller(
        robot, [load, ball], avoidance=Avoidance(d1=0.02, d2=0.1, backup=Backup(preferred_distance=0.5))
    )
    planner = backup_of(controller)
    for change in (
        lambda: controller.attach("load", "y", robot.home),
        lambda: controller.allow_contact("load", ["ball"]),
        lambda: controller.release("load", robot.home),
    ):
        controller.filter(robot.home, np.zeros(2), 0.0)
        assert planner._backup is not None and planner.rollouts.is_valid_from(planner._backup, planner._backup.start)
        change()
        assert not planner.rollouts.is_valid_from(planner._backup, planner._backup.start)


def test_rollout_moves_attached_objects(tmp_path):
    """Rates of the distances of an attached object, by finite differences; before, no joint moves it."""
    load = Obstacle.at("load", Sphere(radius=0.02), [0.3, 0.0, 0.0], graspable=True)
    ball = Obstacle(
        "ball", Sphere(radius=0.1), build_motion(Line(start=(0.3, 0.3, 0), end=(1, 1, 0), speed=0.01)), True
    )
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    controller = make_controller(robot, [load, ball], avoidance=Avoidance(d1=0.02, d2=0.1))
    rollouts, q = backup_of(controller).rollouts, robot.home
    pair = next(i for i, names in enumerate(controller.scene.pair_names) if set(names) == {"load", "ball"})
    assert not rollouts.separable_pairs[pair]
    controller.attach("load", "y", q)
    assert rollouts.separable_pairs[pair]

    def evaluate(q):
        start = Start(q, *np.zeros((2, 2)), 0.0, rollouts.separable_pairs)
        near = rollouts._evaluate(q, 0.0, np.zeros(2), ContactAccumulator(start, 1.5), 0.0)
        (row,) = np.flatnonzero(rollouts._layout.near_pairs[: len(near.feedforward)] == pair)
        return near.closest[row, 0], near.J[row].copy()

    d, J = evaluate(q)
    assert d == pytest.approx(0.3 - 0.12)
    numeric = [(evaluate(q + h)[0] - evaluate(q - h)[0]) / 2e-6 for h in 1e-6 * np.eye(2)]
    np.testing.assert_allclose(J, numeric, atol=1e-6)
    assert J[1] == pytest.approx(-1.0)
    controller.release("load", q)
    assert not rollouts.separable_pairs[pair]


def test_external_obstacles_as_predicted_need_no_new_rollouts(tmp_path):
    """The prediction error bounds the error of a trajectory: none is computed for what cannot bring it into contact."""
    robot = cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
    counts = {}
    for noise in (0.0, 1e-4, 0.05):
        rng = np.random.default_rng(0)
        ball = Obstacle.at("ball", Sphere(radius=0.1), [0.5, 0.0, 0.0])
        controller = make_controller(robot, [ball], "y", avoidance=Avoidance(d1=0.02, d2=0.10))
        times = []
        count_rollouts(controller, times.append)
        q = robot.home.copy()
        for k in range(60):
            at = [0.3 - 0.05 * DT * k, 0.0, 0.0] + noise * rng.normal(size=3)
            update = {"ball": Sample.at(at, linear=[-0.05, 0.0, 0.0])}
            q = pin.integrate(
                robot.model, q, DT * controller.step(q, k * DT, {"y": Sample.at([0.0, 0.0, 0.0])}, update).v
            )
        counts[noise] = len(times)
    assert 0 < counts[0.0] <= counts[1e-4] < 10 < counts[0.05]


def test_paths_agree_with_predicted_states():
    times, update = np.array([0.3, 0.4, 1.9]), {"b": Sample.at([0, 1, 0], linear=[0.1, 0, 0.2], angular=[0, 0, 3.0])}
    line = build_motion(Line(start=(0.0, 0.6, 0.0), end=(0.0, -2.0, 0.0), speed=0.5))
    still = Obstacle.at("still", Sphere(radius=0.1), [9.0, 0.0, 0.0])
    obstacles = ObstacleTracker(
        [still, Obstacle("a", Sphere(radius=0.1), line, True), Obstacle.at("b", Sphere(radius=0.1), [0, 0, 0])],
        Sensing(),
        0.1,
    )
    for k in range(4):
        obstacles.advance(obstacles.read(0.1 * k, update if k % 2 else None))
        places, rates = obstacles.paths(times)
        assert obstacles.any_may_move and len(rates) == (2 if k else 1)
        for t, row in zip(times, places, strict=True):
            np.testing.assert_allclose(row, obstacles.at(t).states[obstacles.moving, 9:12], rtol=0, atol=1e-12)
        expected = [[0.5, 0.0], [np.sqrt(0.05), 3.0]][: len(rates)]
        np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-12)
    resting = ObstacleTracker([still], Sensing(), 0.1)
    for twist, any_may_move in (([0, 0, 0], False), ([0, 0, 0.1], True)):
        resting.advance(resting.read(0.0, {"still": Sample.at([9.0, 0.0, 0.0], linear=twist)}))
        assert resting.any_may_move == any_may_move


def test_prediction_uses_the_mean_twist():
    """Poses with a noise of 5 mm give twists with errors of 0.7 m/s, but predictions without."""
    dt, rng = 0.01, np.random.default_rng(0)
    obstacles, off = ObstacleTracker([Obstacle.at("ball", Sphere(radius=0.1), [0, 0, 0])], Sensing(), dt), []
    for k in range(200):
        t = k * dt
        at = np.array([0.2 * t, 0.0, 0.0])
        obstacles.advance(obstacles.read(t, {"ball": Pose.at(at + 0.005 * rng.normal(size=3))}))
        if k == 1:
            first = obstacles.estimates.states[0, 12:15]
            np.testing.assert_array_equal(first, obstacles._current.states[0, 12:15])  # of one twist, that is the mean
        if k > 50:
            off.append(obstacles.at(t + 1.0).states[0, 9:12] - at - [0.2, 0.0, 0.0])
            places, _ = obstacles.paths(np.array([t + 1.0]))
            np.testing.assert_allclose(places[0, 0], obstacles.at(t + 1.0).states[0, 9:12], rtol=0, atol=1e-12)
    assert np.std(off) < 0.05 and np.abs(np.mean(off, axis=0)).max() < 0.02


def test_clock_jitter_costs_no_rollouts(tmp_path):
    counts = {}
    for jitter in (0.0, 1e-3):
        rng, robot = np.random.default_rng(0), cartesian(tmp_path, "xy", speed=0.25, acceleration=None)
        controller = make_controller(robot, closing_balls(speed=0.12), "y", avoidance=Avoidance(d1=0.02, d2=0.10))
        times = []
        count_rollouts(controller, times.append)
        q = robot.home.copy()
        for k in range(300, 480):
            t = k * DT + jitter * rng.uniform(-1.0, 1.0)
            q = pin.integrate(robot.model, q, DT * controller.step(q, t, {"y": Sample.at([0.0, 0.0, 0.0])}).v)
        counts[jitter] = len(times)
    assert counts[0.0] > 5 and counts[1e-3] < 2 * counts[0.0] < 100


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 0.3))
def test_prediction_error_bound_covers_every_point(seed, size):
    rng, dt = np.random.default_rng(seed), 0.05
    names = ["a", "b"]
    obstacles = ObstacleTracker([Obstacle.at(name, Sphere(radius=0.1), [0, 0, 0]) for name in names], Sensing(), dt)

    def sample(turn, *parts):
        return Sample(parts[0], pin.exp3(turn), *parts[1:])

    first = {name: [rng.normal(size=3) for _ in range(4)] for name in names}
    obstacles.advance(obstacles.read(0.0, {name: sample(*parts) for name, parts in first.items()}))
    before, radii = obstacles.estimates, np.array([0.2, 0.3])
    then = {name: obstacles.at(dt).states[i] for i, name in enumerate(names)}
    now = {}
    for name, state in then.items():
        R = state[:9].reshape(3, 3).T @ pin.exp3(size * rng.normal(size=3))
        now[name] = Sample(
            *(state[9:12] + size * rng.normal(size=3), R), *(state[12:].reshape(2, 3) + size * rng.normal(size=(2, 3)))
        )
    obstacles.advance(obstacles.read(dt, now))
    bound = prediction_error_bound(obstacles.estimates, before, 1.0, radii)
    for i, name in enumerate(names):
        for t in np.linspace(0.0, 1.0, 11):
            points = rng.normal(size=(50, 3))
            points *= radii[i] / np.linalg.norm(points, axis=1, keepdims=True)
            states = np.array([then[name], obstacles.estimates.states[i]])
            extrapolate(states, t)
            places = [points @ state[:9].reshape(3, 3) + state[9:12] for state in states]
            assert np.linalg.norm(places[0] - places[1], axis=1).max() <= bound + 1e-9
    assert prediction_error_bound(obstacles.estimates, before, 1.0, np.array([np.inf, 0.3])) == np.inf or size < 1e-9
    assert bound > 0.0 or size < 1e-9
    obstacles.reset()
    assert prediction_error_bound(obstacles.estimates, before, 1.0, radii) == np.inf
