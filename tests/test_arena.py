"""The arena's closed loop, its checker's distances and its scores, against closed forms and against `simulate`."""

from dataclasses import replace

import numpy as np
import pytest

from qpavoid import Solution, load_scenario
from qpavoid.errors import ConfigError
from qpavoid.run.mujoco import build
from qpavoid.run.simulate import simulate
from qpavoid_bench.arena.case import Case, Sensor, SensorModel
from qpavoid_bench.arena.checker import Contact, Findings, check_run
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family
from qpavoid_bench.arena.families import make_case as make_torque_case
from qpavoid_bench.arena.rollout import Rollout, roll_out
from qpavoid_bench.arena.scores import COLUMNS, score
from qpavoid_bench.arena.trial import run_trial
from qpavoid_bench.arena.world import build_world

DT = 0.01


def make_case(name="ur5_pole", sensor=None, reachable=True, **changes):
    scenario = load_scenario(name, [f"{key}={value}" for key, value in changes.items()])
    return Case("shipped", 3, scenario, sensor or Sensor(), reachable, "it ships")


class Constant:
    """Commands the same velocity for ever."""

    def __init__(self, v):
        self.v = np.asarray(v)

    def step(self, q, t, targets, obstacles):
        return Solution(self.v)


class Broken(Constant):
    """Fails from its third tick on, in one way or another."""

    def __init__(self, v, how):
        super().__init__(v)
        self.how, self.count = how, 0

    def step(self, q, t, targets, obstacles):
        self.count += 1
        if self.count < 3:
            return Solution(self.v)
        if self.how == "raises":
            raise RuntimeError("no solution found")
        return Solution(np.full(len(self.v), np.nan))


def test_case_json_round_trip():
    """A case survives json and its key tells cases apart."""
    case = make_case(duration=1, sensor=Sensor(delay=0.05))
    rerun = Case.from_json(case.to_json())
    assert rerun == case and rerun.key == case.key and rerun.scenario.source == case.scenario.source
    others = [replace(case, seed=4), replace(case, sensor=Sensor()), make_case(duration=1.5)]
    assert len({case.key, *(other.key for other in others)}) == 4


def test_sensor_model_delay():
    """A perfect sensor tells what moves and a late one what was."""
    case = make_case("moving_sphere")
    world = build_world(case.scenario)
    (moving,) = [obstacle for obstacle in world.scene.obstacles if obstacle.moves]
    seen = SensorModel(case, world.scene.obstacles).measure(1.0)
    assert list(seen) == [moving.name]
    assert np.array_equal(seen[moving.name].position, moving.motion.sample(1.0).position)
    late = SensorModel(replace(case, sensor=Sensor(delay=0.25)), world.scene.obstacles)
    assert np.array_equal(late.measure(1.0)[moving.name].position, moving.motion.sample(0.75).position)
    assert np.array_equal(late.measure(0.1)[moving.name].position, moving.motion.sample(0.0).position)


def test_sensor_model_noise():
    """Noise has the stated spread and is the same for all."""
    case = make_case("moving_sphere", Sensor(position_noise=0.01, velocity_noise=0.05))
    world = build_world(case.scenario)
    first, second = (SensorModel(case, world.scene.obstacles) for _ in range(2))
    errors = []
    for t in np.arange(0.0, 20.0, DT):
        one, two = first.measure(t), second.measure(t)
        for obstacle in world.scene.obstacles:
            truth, seen = obstacle.motion.sample(t), one[obstacle.name]
            assert np.array_equal(seen.position, two[obstacle.name].position)
            if obstacle.moves:
                errors.append(np.concatenate((seen.position - truth.position, seen.linear - truth.linear)))
    spread = np.std(errors, axis=0)
    assert spread[:3] == pytest.approx(0.01, rel=0.1) and spread[3:] == pytest.approx(0.05, rel=0.1)


def test_rollout_follows_velocities_exactly():
    """Velocities are followed exactly."""
    case = make_case(duration=1)
    world, v = build_world(case.scenario), np.array([0.1, -0.05, 0.02, 0.0, 0.3, -0.1])
    rollout = roll_out(case, Constant(v), world)
    assert len(rollout.t) == 101 and not rollout.failed.any() and rollout.failure == ""
    assert rollout.q == pytest.approx(world.q0 + rollout.t[:, None] * v, abs=1e-12)
    assert np.all(rollout.v == v)


@pytest.mark.parametrize(("how", "said"), [("raises", "RuntimeError: no solution found"), ("nan", "NaN or infinity")])
def test_rollout_counts_failures(how, said):
    """An entrant that fails is held and every tick counts."""
    case = make_case(duration=1)
    world, v = build_world(case.scenario), np.full(6, 0.1)
    rollout = roll_out(case, Broken(v, how), world)
    assert rollout.failed.tolist() == [0.0] * 2 + [1.0] * 99 and said in rollout.failure
    assert rollout.q[2:] == pytest.approx(np.tile(world.q0 + 2 * DT * v, (99, 1)), abs=1e-12)


def test_rollout_time_budget():
    case = make_case(duration=1)
    rollout = roll_out(case, Constant(np.zeros(6)), build_world(case.scenario), time_budget=1e-9)
    assert rollout.failed.sum() == 100 and rollout.failure == "out of time"


@pytest.mark.parametrize("name", ["ur5_pole", "moving_sphere", "crossing_arms"])
@pytest.mark.parametrize("solver", ["qp", "eq10", "tracking"])
def test_rollout_equals_simulate(name, solver):
    """The loop is that of simulate."""
    case = make_case(name, duration=3)
    world = build_world(case.scenario)
    entrant = ENTRANTS[solver]
    rollout = roll_out(case, entrant.start(case, world), world)
    log = simulate(load_scenario(name, ["duration=3"], solver))  # one name means one thing, safety options included
    assert rollout.q == pytest.approx(log.q, abs=1e-9)
    assert rollout.tool == pytest.approx(log.tool, abs=1e-9)


def test_checker_distances_below_threshold_are_exact():
    """Distances below the threshold are the true ones."""
    case = make_case(duration=4)
    world = build_world(case.scenario)
    rollout = roll_out(case, ENTRANTS["tracking"].start(case, world), world)
    mujoco_model = build(world.scene, world.q0)
    near = 0.05
    findings = check_run(mujoco_model, rollout.t, rollout.v, case.scenario.limits, near)
    movable, below = np.flatnonzero(mujoco_model.movable), 0
    for k in range(0, len(rollout.t), 7):
        mujoco_model.place(findings.q[k], rollout.t[k])
        smallest = min(mujoco_model.distance(pair) for pair in movable)
        if smallest < near:
            assert findings.nearest[k] == pytest.approx(smallest, abs=1e-9)
            below += 1
        else:
            assert near <= findings.nearest[k] <= smallest + 1e-9
    assert below > 5


def made_by_hand(case, tool, target, v):
    """A rollout and findings with nothing in them but what is given."""
    count = len(tool)
    world = build_world(case.scenario)
    t, q = DT * np.arange(count), np.tile(world.q0, (count, 1))
    zeros = np.zeros(count)
    rollout = Rollout(t, q, v, tool[:, None], target[:, None], zeros.astype(int), zeros, zeros, "")
    findings = Findings(0.1, 0, 0.0, (), q, np.full(count, 0.1), -1.0, -1.0, -1.0, count)
    return world, rollout, findings


def test_scores_of_a_known_motion():
    case = make_case(duration=2)
    t = DT * np.arange(201)
    along, v = np.zeros((201, 3)), np.zeros((201, 6))
    along[:, 0] = np.minimum(0.1 * t, 0.1)  # the target rests after a second
    tool = along + np.array([0.0, 0.03, 0.0])
    tool[151:] = along[151:]  # there after 1.51 s
    v[:, 0] = t**2  # jerk 2 rad/s³ in one of six joints
    world, rollout, findings = made_by_hand(case, tool, along, v)
    row = score(case, world, "x", "y", rollout, findings, 0.0)
    assert row.arrived and row.success and not row.stuck and row.final_error == 0.0
    assert row.time_to_goal == pytest.approx(151 / 201)
    assert row.tracking_error == pytest.approx(0.03 * np.sqrt(151 / 201))
    assert row.deviation == pytest.approx(0.03)
    assert row.path_length == pytest.approx((0.1 + 0.03) / 0.1)
    assert row.jerk == pytest.approx(2.0 / np.sqrt(6.0))
    assert row.jitter == pytest.approx(2.0)
    assert row.below_d1 == 0.0 and row.violations == pytest.approx(np.mean(t**2 > np.pi), abs=0.01)
    assert set(row.row()) == set(COLUMNS)


def test_score_counts_jerk_violations():
    """Speeds that grow by 0.7 t² have a jerk of 1.4 rad/s³."""
    base, v = make_case(duration=2), np.zeros((201, 6))
    v[:, 0] = 0.7 * (DT * np.arange(201)) ** 2
    for limit, share in ((None, 0.0), (1.5, 0.0), (1.3, 199 / 201)):
        limits = base.scenario.limits.model_copy(update={"acceleration": 9.0, "jerk": limit})
        case = replace(base, scenario=base.scenario.model_copy(update={"limits": limits}))
        world, rollout, findings = made_by_hand(case, np.zeros((201, 3)), np.zeros((201, 3)), v)
        row = score(case, world, "x", "y", rollout, findings, 0.0)
        assert row.violations == pytest.approx(share, abs=1.5 / 201)


def test_score_success():
    """What counts as success."""
    case = make_case(duration=2)
    rest, v = np.zeros((201, 3)), np.zeros((201, 6))
    away = rest + np.array([0.1, 0.0, 0.0])
    world, rollout, findings = made_by_hand(case, away, rest, v)
    row = score(case, world, "x", "y", rollout, findings, 0.0)
    assert not row.success and row.stuck and row.time_to_goal == 1.0 and row.final_error == pytest.approx(0.1)
    unreachable = score(replace(case, reachable=False), world, "x", "y", rollout, findings, 0.0)
    assert unreachable.success and not unreachable.stuck  # clear and at rest is all that can be asked
    touched = replace(findings, contacts=(Contact(0, 1.0, 0.01),), nearest=np.full(201, 0.01))
    row = score(replace(case, reachable=False), world, "x", "y", rollout, touched, 0.0)
    assert row.collided and not row.success and not row.stuck and row.below_d1 == 1.0
    shaking = away + 0.01 * np.sin(np.arange(201))[:, None]
    world, rollout, findings = made_by_hand(case, shaking, rest, v)
    assert not score(replace(case, reachable=False), world, "x", "y", rollout, findings, 0.0).success


def test_trial_separates_avoidance_from_tracking():
    """A trial tells a law that avoids from one that does not."""
    case = make_case()
    tracking, qp = (run_trial(case, ENTRANTS[name]) for name in ("tracking", "qp"))
    assert tracking.collided and tracking.min_distance < 0.0 and tracking.tracking_error < 1e-3
    assert qp.success and qp.min_distance >= qp.d1 - 1e-3 and qp.tick_p99 >= qp.tick_p50 > 0.0
    assert tracking.case == qp.case and tracking.settings != qp.settings


def test_a_plant_moves_an_arm_whose_torques_are_within_limits():
    case = make_torque_case(load_family("torque_arm"), 0)
    case = replace(case, scenario=case.scenario.model_copy(update={"duration": 0.2}))
    world = build_world(case.scenario)
    rollout = roll_out(case, ENTRANTS["qp"].start(case, world), world)
    assert rollout.torque.shape == (201, 7) and not rollout.failed.any() and rollout.fallen == 0.0
    row = run_trial(case, ENTRANTS["qp"])
    assert 0.1 < row.torque <= 1.0 and row.torque_jitter > 0.0 and row.slip == row.fallen == 0.0
    assert not row.collided and row.violations == 0.0


def test_a_humanoid_that_is_not_held_falls_and_its_run_ends():
    """With the torques of zero velocity commanded for ever, it falls; who gives no torques fails at every step."""
    case = make_torque_case(load_family("standing_humanoid"), 0)
    scenario = case.scenario.model_copy(update={"duration": 1.5})
    case = replace(case, scenario=scenario)
    world = build_world(scenario)

    class Limp:
        def step(self, q, t, targets, obstacles, v):
            return Solution(np.zeros(35), torque=np.zeros(29))

    rollout = roll_out(case, Limp(), world)
    assert 0.0 < rollout.fallen < 0.9 and len(rollout.t) == round((1.0 - rollout.fallen) * 1501)
    model = build(world.scene, world.q0)
    findings = check_run(model, rollout.t, rollout.v, scenario.limits, 0.0, rollout.q)
    np.testing.assert_array_equal(findings.q, rollout.q)
    row = score(case, world, "x", "y", rollout, findings, 0.0)
    assert not row.success and row.fallen == rollout.fallen and row.torque == 0.0
    rollout = roll_out(case, Constant(np.zeros(35)), world)
    assert rollout.failed.all() and "unexpected keyword argument 'v'" in rollout.failure


@pytest.mark.parametrize("contacts", [True, False])
def test_contacts_and_torques_need_a_plant(contacts):
    """Cases that cannot be checked are refused."""
    scenario = load_scenario("g1_wave", ["plant=null"] + ["contacts=[]"] * (not contacts))
    with pytest.raises(ConfigError, match="plant"):
        build_world(scenario)


def test_every_installed_entrant_runs():
    """Every law that is installed runs; the hulls of this robot are refused by some libraries."""
    case = make_case(duration=0.2)
    for entrant in ENTRANTS.values():
        if not entrant.missing:
            failure = run_trial(case, entrant).failure
            assert failure == "" or (entrant.library and "Convex" in failure), entrant.name
