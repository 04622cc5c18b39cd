"""Independent checker and safety campaign: distances, contacts between steps, verdicts, a small campaign."""

from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from conftest import BOX, CAPSULE, CYLINDER, SPHERE, obstacle, random_q, random_scene, write_chain

from qpavoid import Limits, Robot, ScenarioConfig, build_scene, load_scenario
from qpavoid.run.simulate import simulate

pytest.importorskip("mujoco")
pytest.importorskip("bench.safety", reason="bench/safety is in the repository only")

from bench.safety import report
from bench.safety.campaign import FOLDER, KINDS, RANGES, draw
from bench.safety.referee import disagreement, drift, referee
from bench.safety.rollout import Start, evade, joint_limits, policies
from bench.safety.trial import trials
from bench.safety.verdict import judge
from qpavoid_bench.arena.checker import STEP, DistanceMonitor
from qpavoid_bench.arena.mujoco_model import build, load_model

PLATE = BOX.model_copy(update={"size": (0.3, 0.2, 0.006)})


@cache
def robot(name):
    return Robot.load(name, FOLDER)


@cache
def situation(solver):
    scenario = load_scenario("situation1")
    return load_model(scenario), simulate(scenario, solver)


def scene_of(robot_path, tasks, obstacles, **fields):
    config = {"robot": str(robot_path), "tasks": tasks, "obstacles": obstacles, **fields}
    return ScenarioConfig.model_validate(config).with_source(Path("handmade.yaml"))


# --- the MuJoCo model ----------------------------------------------------------------------------------------------


def coal_distances(scene, q):
    """(m,) by pinocchio and coal, without anything of ours."""
    model, data = scene.robot.model, scene.geometry.createData()
    pin.updateGeometryPlacements(model, model.createData(), scene.geometry, data, q)
    pin.computeDistances(scene.geometry, data)
    return np.array([result.min_distance for result in data.distanceResults])


@pytest.mark.parametrize("name", [kind.robot for kind in KINDS])
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
            radii = [bodies[body].geometry.radius for body in scene.pairs[pair].tolist() if body < mujoco_model.bodies]
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


def test_a_floating_base_is_refused(solo):
    with pytest.raises(ValueError, match="neither a hinge nor a slide"):
        build(random_scene(solo, np.random.default_rng(0), [SPHERE]), solo.home)


# --- the checker --------------------------------------------------------------------------------------------


def test_checker_collision_depth_of_situation_1():
    """It finds the collision of situation 1 and its depth."""
    mujoco_model, log = situation("tracking")
    findings = referee(mujoco_model, log)
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
    findings = referee(mujoco_model, log)
    assert findings.contacts == ()
    assert findings.distance > 0.08  # d1
    assert findings.distance == pytest.approx(log.min_distance.min(), abs=1e-4)
    assert disagreement(mujoco_model, log, findings) < 1e-6 and drift(log, findings) < 1e-9


def test_checker_integrates_velocities_itself():
    """It integrates the velocities and ignores the logged configurations."""
    mujoco_model, log = situation("tracking")
    moved = replace(log, q=log.q + 0.1)
    findings, moved_findings = referee(mujoco_model, log), referee(mujoco_model, moved)
    assert moved_findings.contacts == findings.contacts
    assert drift(moved, moved_findings) == pytest.approx(0.1)


def test_checker_joint_limits():
    """It checks the joint limits."""
    mujoco_model, log = situation("qp")
    bounds = mujoco_model.scene.robot.bounds()
    assert referee(mujoco_model, log).speed_excess <= 0.0
    fast = log.v.copy()
    fast[10:20, 2] = bounds.velocity[2] + 0.5
    assert referee(mujoco_model, replace(log, v=fast)).speed_excess == pytest.approx(0.5)
    steady = np.zeros_like(log.v)
    steady[:, 0] = 1.0  # rad/s, for 12.99 s
    excess = mujoco_model.q0[0] + 13.0 - bounds.upper[0]
    assert referee(mujoco_model, replace(log, v=steady)).position_excess == pytest.approx(excess, abs=0.02)


def test_checker_accelerations():
    """It checks accelerations."""
    scenario = load_scenario("situation1", ["limits.acceleration=3.0", "duration=1.0"])
    mujoco_model, log = load_model(scenario), simulate(scenario, "tracking")
    v = np.zeros_like(log.v)
    v[5:, 1] = 0.05  # rad/s, within one tick of 0.01 s
    assert referee(mujoco_model, replace(log, v=v)).acceleration_excess == pytest.approx(5.0 - 3.0)
    assert referee(*situation("tracking")).acceleration_excess == -np.inf


def test_checker_refuses_log_of_another_scene():
    """It refuses the log of another scene."""
    mujoco_model, _ = situation("qp")
    with pytest.raises(ValueError, match="another scene"):
        referee(mujoco_model, simulate(load_scenario("situation2", ["duration=0.1"])))


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
    findings = referee(mujoco_model, log)
    assert log.min_distance.min() > 0.05
    assert [mujoco_model.scene.pair_names[contact.pair] for contact in findings.contacts] == [("link1_0", "plate")]
    assert findings.contacts[0].time == pytest.approx((0.45 - 0.033) / 3.0, abs=STEP)


@pytest.mark.parametrize("seed", [2, 9])
def test_checker_skipped_pairs_do_not_matter(seed):
    """What it does not measure again does not matter."""
    scenario = draw(seed)
    mujoco_model, log = load_model(scenario), simulate(scenario, "tracking")
    findings = referee(mujoco_model, log)
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


def test_checker_travel_between_instants():
    """No step is longer than it says."""

    class Seen(DistanceMonitor):
        def measure(self, t):
            centers.append(mujoco_model.poses()[0].copy())
            super().measure(t)

    mujoco_model, centers = load_model(draw(9)), []
    watch = Seen(mujoco_model)
    watch.measure(0.0)
    watch.follow(mujoco_model.q0, 0.5 * mujoco_model.scene.robot.bounds().velocity, 0.0, 0.05)
    assert len(centers) > 5
    assert np.linalg.norm(np.diff(centers, axis=0), axis=2).max() <= 1.05 * STEP


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
    verdicts = judge(mujoco_model, scenario, log, referee(mujoco_model, log))
    assert [verdict.why for verdict in verdicts] == why, verdicts
    assert verdicts[-1].avoidable == (why[-1] == "avoidable")


@pytest.mark.parametrize("acceleration", [None, 10.0])
def test_backup_rollouts_respect_limits(monkeypatch, acceleration):
    steps, follow = [], DistanceMonitor.follow

    def recorded(watch, q, v, t, dt):
        after = follow(watch, q, v, t, dt)
        steps.append((after, v))
        return after

    monkeypatch.setattr(DistanceMonitor, "follow", recorded)
    limits = Limits(acceleration=acceleration)
    scenario = draw(9).model_copy(update={"limits": limits, "dt": 0.02})
    mujoco_model = load_model(scenario)
    means = joint_limits(mujoco_model, scenario)
    start = Start(mujoco_model.q0, np.zeros_like(mujoco_model.q0), 0.0, 1.2)
    for policy in list(policies(len(mujoco_model.q0)))[::3]:
        steps.clear()
        evade(mujoco_model, means, start, scenario.dt, policy, mujoco_model.movable)
        q, v = (np.array(array) for array in zip(*steps, strict=True))
        assert np.all(np.abs(v) <= means.speed + 1e-9)
        assert np.all((q >= means.lower - 1e-6) & (q <= means.upper + 1e-6))
        change = np.abs(np.diff(v, axis=0, prepend=0.0))
        assert np.all(change <= scenario.dt * means.acceleration + 1e-9)


def test_standing_still_proves_that_a_static_obstacle_is_avoidable():
    scenario, (mujoco_model, log) = load_scenario("situation1"), situation("tracking")
    (verdict,) = judge(mujoco_model, scenario, log, referee(mujoco_model, log))
    assert verdict.why == "avoidable" and "standing still" in verdict.detail


# --- the campaign -------------------------------------------------------------------------------------------


def test_scenarios_can_be_drawn_again_and_begin_clear():
    drawn = [draw(seed) for seed in range(30)]
    assert drawn == [draw(seed) for seed in range(30)]
    assert {scenario.robot for scenario in drawn} == {kind.robot for kind in KINDS}
    assert len({scenario.dt for scenario in drawn}) > 3
    assert max(len(scenario.obstacles) for scenario in drawn) > 10
    for scenario in drawn:
        mujoco_model = load_model(scenario)
        smallest = min(mujoco_model.distance(pair) for pair in range(len(mujoco_model.scene.pairs)))
        assert smallest > scenario.avoidance.d1 - 1e-6, scenario.title
        assert RANGES.d1[0] <= scenario.avoidance.d1 <= RANGES.d1[1]
        assert RANGES.duration[0] <= scenario.duration <= RANGES.duration[1]


@cache
def small_campaign(solver, count):
    seeds = (seed for seed in range(100) if draw(seed).dt > 0.002)  # short periods take many ticks
    return [trial for seed in islice(seeds, count) for trial in trials(seed, (solver,))]


def test_qp_has_no_avoidable_collision():
    found = small_campaign("qp", 15)
    assert {(trial.seed, trial.judged) for trial in found if trial.avoidable} == set()
    assert all(trial.speed_excess < 1e-9 and trial.position_excess < 1e-9 for trial in found)
    assert all(trial.disagreement < 1e-6 and trial.drift < 1e-6 and not trial.failure for trial in found)


@pytest.mark.parametrize("seed", [13, 79, 99, 122, 912, 957])
def test_qp_regressions_of_collisions(seed):
    """Margins bought with jumps of a wrist, ways that bend, a stop that let an obstacle come on."""
    (trial,) = trials(seed, ("qp",))
    assert not trial.avoidable, trial.judged


@pytest.mark.parametrize(
    ("seed", "blind"), [(265, True), (419, True), (309, False), (488, False), (559, False), (670, False)]
)
def test_backup_evades_closing_obstacles(seed, blind):
    """Obstacles that close in from several sides, on a robot that follows its task until it is too late to evade.

    Without it all are hit (bench/results/safety.md); the referee takes up to a minute to say that they need not be.
    """
    found = trials(seed, ("qp", "qp-alone") if blind else ("qp",))
    assert not found[0].collided and found[0].speed_excess <= 1e-9, found[0].judged
    assert all(trial.avoidable for trial in found[1:])


@pytest.mark.parametrize("seed", [768, 1084])
def test_backup_avoids_contacts_beside_unavoidable_one(seed):
    """A pair that touches in every rollout must not make the planner ignore the other pairs."""
    (trial,) = trials(seed, ("qp",))
    assert trial.collided and not trial.avoidable, trial.judged


def test_tracking_alone_collides_and_could_have_avoided_it():
    assert sum(trial.avoidable for trial in small_campaign("tracking", 8)) > 4


def test_the_report_has_every_run(tmp_path):
    found = small_campaign("qp", 15) + small_campaign("tracking", 8)
    text = report.write(found, {99: "ValueError: no"}, ("qp", "tracking"), report.Cost(60.0, (0.1, 0.2)), tmp_path, "s")
    assert (tmp_path / "s.md").read_text() == text
    assert len((tmp_path / "s.csv").read_text().splitlines()) == 1 + len(found)
    assert "seed 99: ValueError: no" in text
    bad = [trial for trial in found if trial.solver == "tracking" and trial.avoidable]
    assert f"| **{len(bad)}** |" in text
    assert all(f"| {trial.seed} | {trial.robot} |" in text for trial in bad[: report.LISTED])
