"""Independent checker and its verdicts: distances, contacts between steps, evasions, cases that once were contacts."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import BOX, CAPSULE, CYLINDER, SPHERE, obstacle, random_q, random_scene, write_chain

from qpavoid import Limits, Robot, ScenarioConfig, build_scene, load_scenario
from qpavoid.control.scenario import build_parts
from qpavoid.run.simulate import simulate

pytest.importorskip("mujoco")

from qpavoid.run.mujoco import build
from qpavoid_bench.arena.checker import STEP, DistanceMonitor, check_run
from qpavoid_bench.arena.evasion import JointLimits, Start, evade, policies
from qpavoid_bench.arena.families import load_family
from qpavoid_bench.arena.families.make import make_case
from qpavoid_bench.arena.verdict import decisive, judge

ROBOTS = ("panda-capsules", "paper-dual-arm", "ur5")
PLATE = BOX.model_copy(update={"size": (0.3, 0.2, 0.006)})


@cache
def robot(name):
    return Robot.load(name)


@cache
def situation(solver):
    scenario = load_scenario("situation1")
    return load_model(scenario), simulate(scenario, solver)


def load_model(scenario):
    parts = build_parts(scenario)
    return build(parts.scene, parts.q0)


def scene_of(robot_path, tasks, obstacles, **fields):
    config = {"robot": str(robot_path), "tasks": tasks, "obstacles": obstacles, **fields}
    return ScenarioConfig.model_validate(config).with_source(Path("handmade.yaml"))


@cache
def recorded_case(seed):
    """A random scenario in which a solver once touched something."""
    cases = json.loads(Path(__file__).with_name("adversarial_cases.json").read_text())
    return ScenarioConfig.model_validate(cases[str(seed)]).with_source(Path(f"seed-{seed}.yaml"))


def check(model, log):
    return check_run(model, log.t, log.v, Limits.model_validate(log.meta["config"]["limits"]))


def drift(log, findings):
    """Largest difference between the log's configurations and MuJoCo's [rad or m]."""
    return np.abs(findings.q - log.q).max()


def disagreement(model, log, findings):
    """Largest difference of the log's smallest distance, where there is no contact, from MuJoCo's of that pair [m]."""
    worst = 0.0
    for k in np.flatnonzero((log.min_distance > 0.0) & (log.min_distance < np.inf)).tolist():
        model.place(findings.q[k], log.t[k])
        worst = max(worst, abs(model.distance(log.closest_pair[k]) - log.min_distance[k]))
    return worst


# --- the MuJoCo model ----------------------------------------------------------------------------------------------


def coal_distances(scene, q):
    """(m,) by pinocchio and coal, without anything of ours."""
    model, data = scene.robot.model, scene.geometry.createData()
    pin.updateGeometryPlacements(model, model.createData(), scene.geometry, data, q)
    pin.computeDistances(scene.geometry, data)
    return np.array([result.min_distance for result in data.distanceResults])


@pytest.mark.parametrize("name", ROBOTS)
def test_distances_are_those_of_coal(name):
    rng, apart, inside = np.random.default_rng(1), 0, 0
    for _ in range(6):
        q = random_q(robot(name), rng)
        data = robot(name).bodies.createData()
        pin.updateGeometryPlacements(robot(name).model, robot(name).model.createData(), robot(name).bodies, data, q)
        bodies = rng.integers(len(data.oMg), size=15).tolist()
        near = [data.oMg[body].translation + rng.uniform(-0.12, 0.12, 3) for body in bodies]
        shapes = zip([SPHERE, CAPSULE, BOX, CYLINDER, PLATE] * 3, near, strict=True)
        obstacles = [obstacle(f"o{i}", shape, at, rng.uniform(-3.0, 3.0, 3)) for i, (shape, at) in enumerate(shapes)]
        scene = build_scene(robot(name), obstacles)
        mujoco_model, bodies = build(scene, robot(name).home), scene.geometry.geometryObjects
        mujoco_model.place(q, 0.0)
        for pair, d in enumerate(coal_distances(scene, q)):
            radii = [
                getattr(bodies[body].geometry, "radius", 0.02)
                for body in scene.pairs[pair].tolist()
                if body < mujoco_model.bodies
            ]
            if d > -0.9 * min(radii):  # MuJoCo's depth means something else once the axis of a capsule is inside a box
                assert mujoco_model.distance(pair) == pytest.approx(d, abs=1e-4), scene.pair_names[pair]
                apart, inside = apart + (d > 0.0), inside + (d < 0.0)
    assert apart > 300 and inside > 30


def test_hulls_are_those_of_coal(panda_convex):
    rng = np.random.default_rng(2)
    robot, _ = panda_convex.lock(["panda_finger*"], panda_convex.home, "test")  # one of them mimics the other one
    scene = random_scene(robot, rng, [SPHERE, BOX, CAPSULE])
    mujoco_model = build(scene, robot.home)
    for _ in range(5):
        q = random_q(robot, rng)
        mujoco_model.place(q, 0.0)
        expected = coal_distances(scene, q)
        got = np.array([mujoco_model.distance(pair) for pair in range(len(expected))])
        np.testing.assert_allclose(got[expected > 0.0], expected[expected > 0.0], atol=1e-4)


def test_a_floating_base_is_placed_but_not_integrated(solo):
    scene, rng = random_scene(solo, np.random.default_rng(0), [SPHERE]), np.random.default_rng(1)
    mujoco_model, v = build(scene, solo.home), np.zeros(solo.model.nv)
    for _ in range(3):
        q = pin.integrate(solo.model, solo.home, rng.uniform(-0.5, 0.5, len(v)))
        mujoco_model.place(q, 0.0)
        expected = coal_distances(scene, q)
        got = np.array([mujoco_model.distance(pair) for pair in range(len(expected))])
        np.testing.assert_allclose(got[expected > 0.0], expected[expected > 0.0], atol=1e-4)
    with pytest.raises(ValueError, match="floats"):
        mujoco_model.integrate(solo.home, v, 0.01)


# --- the checker --------------------------------------------------------------------------------------------


def test_checker_collision_depth_of_situation_1():
    """It finds the collision of situation 1 and its depth."""
    mujoco_model, log = situation("tracking")
    findings = check(mujoco_model, log)
    names = [mujoco_model.scene.pair_names[contact.pair] for contact in findings.contacts]
    assert names == [("left_hand", "fist")]
    # the depth by hand: radii less the distance of the sphere's centre from the hand's axis
    model, k = mujoco_model.scene.robot.model, round(findings.time / 0.01)
    data = model.createData()
    pin.framesForwardKinematics(model, data, log.q[k])
    wrist = data.oMf[model.getFrameId("left_link7")]
    start, end = wrist.translation, wrist.act(np.array([0.0, 0.0, -0.25]))
    center = np.array([0.39644872, 0.41090125, 0.74741443])
    share = np.clip((center - start) @ (end - start) / 0.25**2, 0.0, 1.0)
    depth = 0.1 - np.linalg.norm(start + share * (end - start) - center)
    assert findings.contacts[0].depth == pytest.approx(depth, abs=1e-4)
    assert findings.distance == pytest.approx(-depth, abs=1e-4)
    assert findings.contacts[0].time < findings.time


def test_checker_finds_no_false_contact():
    """It sees none where there is none."""
    mujoco_model, log = situation("qp")
    findings = check(mujoco_model, log)
    assert findings.contacts == ()
    assert findings.distance > 0.08  # d1
    assert findings.distance == pytest.approx(log.min_distance.min(), abs=1e-4)
    assert disagreement(mujoco_model, log, findings) < 1e-6 and drift(log, findings) < 1e-9


def test_checker_integrates_velocities_itself():
    """It integrates the velocities and ignores the logged configurations."""
    mujoco_model, log = situation("tracking")
    moved = replace(log, q=log.q + 0.1)
    findings, moved_findings = check(mujoco_model, log), check(mujoco_model, moved)
    assert moved_findings.contacts == findings.contacts
    assert drift(moved, moved_findings) == pytest.approx(0.1)


def test_checker_joint_limits():
    """It checks the joint limits."""
    mujoco_model, log = situation("qp")
    bounds = mujoco_model.scene.robot.bounds()
    assert check(mujoco_model, log).speed_excess <= 0.0
    fast = log.v.copy()
    fast[10:20, 2] = bounds.velocity[2] + 0.5
    assert check(mujoco_model, replace(log, v=fast)).speed_excess == pytest.approx(0.5)
    steady = np.zeros_like(log.v)
    steady[:, 0] = 1.0  # rad/s, for 12.99 s
    excess = mujoco_model.q0[0] + 13.0 - bounds.upper[0]
    assert check(mujoco_model, replace(log, v=steady)).position_excess == pytest.approx(excess, abs=0.02)


def test_checker_accelerations():
    """It checks accelerations."""
    scenario = load_scenario("situation1", ["limits.acceleration=3.0", "duration=1.0"])
    mujoco_model, log = load_model(scenario), simulate(scenario, "tracking")
    v = np.zeros_like(log.v)
    v[5:, 1] = 0.05  # rad/s, within one tick of 0.01 s
    assert check(mujoco_model, replace(log, v=v)).acceleration_excess == pytest.approx(5.0 - 3.0)
    assert check(*situation("tracking")).acceleration_excess == -np.inf


def test_checker_finds_contact_between_steps(tmp_path):
    """It catches what passes between two ticks."""
    # a plate of 6 mm at 3 m/s goes through a rod of 60 mm while the controller does not look
    plate = {"type": "box", "size": [0.2, 0.006, 0.2]}
    line = {"type": "line", "start": [0.0, -0.45, 0.55], "end": [0.0, 0.45, 0.55], "speed": 3.0}
    scenario = scene_of(
        write_chain(tmp_path, joints=2),
        [{"frame": "link1"}],
        [{"name": "plate", "shape": plate, "motion": line}],
        dt=0.1,
        duration=0.4,
    )
    mujoco_model, log = load_model(scenario), simulate(scenario, "tracking")
    findings = check(mujoco_model, log)
    assert log.min_distance.min() > 0.05
    assert [mujoco_model.scene.pair_names[contact.pair] for contact in findings.contacts] == [("link1_0", "plate")]
    assert findings.contacts[0].time == pytest.approx((0.45 - 0.033) / 3.0, abs=STEP)


@pytest.mark.parametrize("seed", [9, 309])
def test_checker_skipped_pairs_do_not_matter(seed):
    """What it does not measure again does not matter."""
    scenario = recorded_case(seed)
    mujoco_model, log = load_model(scenario), simulate(scenario, "tracking")
    findings = check(mujoco_model, log)
    touched, smallest = set(), np.inf
    for q, t in zip(findings.q, log.t.tolist(), strict=True):
        mujoco_model.place(q, t)
        distances = np.array([mujoco_model.distance(pair) for pair in range(len(mujoco_model.scene.pairs))])
        touched |= set(np.flatnonzero(distances < 0.0).tolist())
        smallest = min(smallest, distances[mujoco_model.movable].min())
    found = {contact.pair for contact in findings.contacts}
    assert touched and touched <= found
    assert smallest - STEP < findings.distance <= smallest + 1e-12
    assert findings.instants >= len(log.t)


# --- verdicts -----------------------------------------------------------------------------------------------


def ball(name, y, speed, z=0.5):
    """A ball that comes along y and stops in the middle of the rod."""
    line = {"type": "line", "start": [0.0, y, z], "end": [0.0, 0.0, z], "speed": speed}
    return {"name": name, "shape": {"type": "sphere", "radius": 0.04}, "motion": line}


@pytest.mark.parametrize(
    ("obstacles", "why"),
    [
        ([ball("left", 0.3, 0.1)], ["avoidable"]),
        ([ball("left", 0.3, 0.1), ball("right", -0.3, 0.1)], ["squeezed", "squeezed"]),
        ([ball("left", 0.6, 2.0)], ["outrun"]),
        ([ball("left", 0.3, 0.1, z=0.15)], ["fixed"]),
        ([ball("below", 0.3, 0.1, z=0.15), ball("left", 0.4, 0.1)], ["fixed", "avoidable"]),
    ],
    ids=["room to go", "from both sides", "too fast", "at the base", "at the base, then room to go"],
)
def test_verdicts(tmp_path, obstacles, why):
    # a rod 0.05 to 0.25 m above its hinge, at up to 1.5 rad/s, with another on top, out of the balls' way
    scenario = scene_of(
        write_chain(tmp_path, joints=2),
        [{"frame": "link1"}],
        obstacles,
        avoidance={"d1": 0.02, "d2": 0.1},
        duration=4.0,
    )
    mujoco_model, log = load_model(scenario), simulate(scenario, "tracking")
    verdicts = judge(mujoco_model, scenario, log.t, log.v, check(mujoco_model, log))
    assert [verdict.kind for verdict in verdicts] == why, verdicts
    assert verdicts[-1].avoidable == (why[-1] == "avoidable")


@pytest.mark.parametrize("acceleration", [None, 10.0])
def test_evasions_respect_limits(monkeypatch, acceleration):
    steps, follow = [], DistanceMonitor.follow

    def recorded(watch, q, v, t, dt):
        after = follow(watch, q, v, t, dt)
        steps.append((after, v))
        return after

    monkeypatch.setattr(DistanceMonitor, "follow", recorded)
    limits = Limits(acceleration=acceleration)
    scenario = recorded_case(9).model_copy(update={"limits": limits, "dt": 0.02})
    mujoco_model = load_model(scenario)
    means = JointLimits.of(mujoco_model, limits)
    start = Start(mujoco_model.q0, np.zeros_like(mujoco_model.q0), 0.0, 1.2)
    for policy in list(policies(len(mujoco_model.q0)))[::3]:
        steps.clear()
        evade(mujoco_model, means, start, scenario.dt, policy, mujoco_model.movable)
        q, v = (np.array(array) for array in zip(*steps, strict=True))
        assert np.all(np.abs(v) <= means.speed + 1e-9)
        assert np.all((q >= means.lower - 1e-6) & (q <= means.upper + 1e-6))
        change = np.abs(np.diff(v, axis=0, prepend=0.0))
        assert np.all(change <= scenario.dt * means.acceleration + 1e-9)


# --- cases ---------------------------------------------------------------------------------------------------


def test_adversarial_cases_begin_clear():
    family = load_family("adversarial")
    cases = [make_case(family, seed) for seed in range(16)]
    assert {case.scenario.robot for case in cases} == set(ROBOTS)
    assert len({case.scenario.dt for case in cases}) > 3
    assert max(len(case.scenario.obstacles) for case in cases) > 10
    for case in cases:
        mujoco_model = load_model(case.scenario)
        smallest = min(mujoco_model.distance(pair) for pair in range(len(mujoco_model.scene.pairs)))
        assert smallest > case.scenario.avoidance.d1, case.scenario.title
        assert not case.solved_by


def run_and_judge(scenario, solver):
    """Return log, findings and the decisive verdict of a run; None without contact."""
    mujoco_model, log = load_model(scenario), simulate(scenario, solver)
    findings = check(mujoco_model, log)
    assert drift(log, findings) < 1e-6 and disagreement(mujoco_model, log, findings) < 1e-6
    assert findings.speed_excess < 1e-9 and findings.position_excess < 1e-9
    return findings, decisive(judge(mujoco_model, scenario, log.t, log.v, findings))


@pytest.mark.parametrize("seed", [79, 912, 957])
def test_qp_regressions_of_collisions(seed):
    """Margins bought with jumps of a wrist, a stop that let an obstacle come on."""
    _, verdict = run_and_judge(recorded_case(seed), "qp")
    assert verdict is None or not verdict.avoidable, verdict


@pytest.mark.parametrize("seed", [309, 559, 670])
def test_backup_evades_closing_obstacles(seed):
    """Obstacles close in from several sides; a robot that follows its task until then cannot evade any more."""
    findings, _ = run_and_judge(recorded_case(seed), "qp")
    assert not findings.contacts


@pytest.mark.slow
def test_backup_avoids_contacts_beside_unavoidable_one():
    """A pair that touches in every rollout must not make the planner ignore the other pairs."""
    findings, verdict = run_and_judge(recorded_case(1084), "qp")
    assert findings.contacts and not verdict.avoidable, verdict


@pytest.mark.parametrize("seed", range(4))
def test_qp_has_no_avoidable_collision_where_tracking_has(seed):
    scenario = make_case(load_family("adversarial"), seed).scenario.model_copy(update={"dt": 0.02})
    scenario = scenario.with_source(Path("seed.yaml"))
    _, verdict = run_and_judge(scenario, "qp")
    assert verdict is None or not verdict.avoidable, verdict
    _, verdict = run_and_judge(scenario, "tracking")
    assert verdict.avoidable
