"""Adapters of other libraries: each sees what this library sees, and is asked for what its tasks ask for."""

import os
import signal
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import Sample, load_scenario
from qpavoid.errors import ConfigError
from qpavoid_bench.arena.case import Case, Sensor
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.libraries.common import frame_tasks, movable_pairs, target_after_step
from qpavoid_bench.arena.libraries.settings import PLACO_PYTHON
from qpavoid_bench.arena.rollout import roll_out
from qpavoid_bench.arena.trial import run_trial
from qpavoid_bench.arena.world import build_world

pytest.importorskip("mujoco")

SCENARIOS = ["panda_line", "crossing_arms", "g1_reach_across"]


@pytest.fixture(params=["pink", "mink", "placo"])
def library(request):
    if ENTRANTS[request.param].missing:
        pytest.skip(f"{request.param} is not installed")
    return request.param


@pytest.fixture
def placo():
    if ENTRANTS["placo"].missing:
        pytest.skip("placo is not installed")


@cache
def make_case(name, *overrides):
    return Case("shipped", 3, load_scenario(name, list(overrides)), Sensor(), True, "it ships")


@cache
def world_of(case_name, *overrides):
    return build_world(make_case(case_name, *overrides).scenario)


def start(library, name, *overrides):
    case, world = make_case(name, *overrides), world_of(name, *overrides)
    return case, world, ENTRANTS[library].start(case, world)


def targets_at(world, t):
    return {task.settings.label: task.motion.sample(t) for task in world.tasks}


def true_distances(world, q, moved):
    """(k,) distances of the pairs that the robot can part, by coal, obstacles `moved` to where they are said to be."""
    scene = world.scene
    geometry, pairs = pin.GeometryModel(scene.geometry), movable_pairs(scene).tolist()
    for number, obstacle in enumerate(scene.obstacles):
        if obstacle.name in moved:
            sample = moved[obstacle.name]
            for piece in np.flatnonzero(scene.obstacle_of == number):
                geometry.geometryObjects[int(piece)].placement = pin.SE3(sample.rotation, sample.position)
    geometry.removeAllCollisionPairs()
    for a, b in pairs:
        geometry.addCollisionPair(pin.CollisionPair(a, b))
    model, data = scene.robot.model, geometry.createData()
    pin.computeDistances(model, model.createData(), geometry, data, q)
    return np.array([result.min_distance for result in data.distanceResults])


def seen_by(library, pilot, world):
    """Distances of the same pairs as the library has them, after its last step; NaN for pairs that it leaves out."""
    if library != "mink":
        return pilot.distances()
    found = pilot.distances()
    return np.array([found.get((a, b), np.nan) for a, b in movable_pairs(world.scene).tolist()])


@pytest.mark.parametrize("name", SCENARIOS)
def test_adapter_frames_and_distances_equal_scene(library, name):
    """Frames and distances are ours."""
    _, world, pilot = start(library, name)
    model, t = world.scene.robot.model, 2.5
    q = pin.integrate(model, world.q0, 0.1 * np.random.default_rng(1).uniform(-1.0, 1.0, model.nv))
    moved = {o.name: o.motion.sample(t) for o in world.scene.obstacles if o.moves}
    pilot.step(q, t, targets_at(world, 0.0), moved)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    frames = pilot.frames(q, moved) if library == "placo" else pilot.frames()
    ours = [data.oMf[task.frame_id].homogeneous for task in world.tasks]
    assert frames == pytest.approx(np.array(ours), abs=1e-6)
    truth, seen = true_distances(world, q, moved), seen_by(library, pilot, world)
    assert not np.isnan(seen).any()
    apart = truth > 0.0  # relative: cylinders and hulls are iterated on, to such a tolerance, from where each begins
    assert apart.mean() > 0.9 and seen[apart] == pytest.approx(truth[apart], rel=4e-6, abs=1e-6)


@pytest.mark.parametrize("kind", ["position", "pose"])
@pytest.mark.parametrize("library", ["mink", "placo"])
def test_adapter_velocity_equals_tracking_without_obstacles(library, kind):
    """With nothing near the velocity is that of our tracking law."""
    if ENTRANTS[library].missing:
        pytest.skip(f"{library} is not installed")
    case, world, pilot = start(library, "ur5_pole", "obstacles=[]", f"tasks.0.type={kind}")
    ours = ENTRANTS["tracking"].start(case, world)
    for t in (0.5, 1.0, 2.0):
        targets = targets_at(world, t)
        v = ours.step(world.q0, t, targets, {}).v
        assert np.abs(v).max() > 0.1
        assert pilot.step(world.q0, t, targets, {}).v == pytest.approx(v, abs=1e-6)


def test_pink_equals_tracking_with_barrier_damping():
    """Pink tracks as we do with the damping of its barrier on top."""
    pytest.importorskip("pink")
    from pink.barriers import SelfCollisionBarrier

    from qpavoid_bench.arena.libraries.settings import DAMPING, PINK

    case, world, pilot = start("pink", "ur5_pole", "obstacles=[]")
    (task,), targets = world.tasks, targets_at(world, 1.0)
    v, model, dt = pilot.step(world.q0, 1.0, targets, {}).v, world.scene.robot.model, case.scenario.dt
    here = pin.SE3(pilot.frames()[0])
    there = pin.SE3(target_after_step(task, targets[task.settings.label], here.homogeneous, dt))
    # a translation of its frame task is that of a screw, so that turning counts: half the step times the turn
    J = pin.computeFrameJacobian(model, model.createData(), world.q0, task.frame_id, pin.ReferenceFrame.LOCAL)
    J = (pin.Jlog6(there.actInv(here)) @ J)[:3]
    e = pin.log6(here.actInv(there)).linear
    rows = SelfCollisionBarrier(min(PINK["n_collision_pairs"], len(movable_pairs(world.scene))))
    scale = PINK["cost"] * np.linalg.norm(rows.compute_jacobian(pilot.configuration))
    damping = DAMPING**2 + PINK["safe_displacement_gain"] / scale**2
    damped = J.T @ J + damping * np.eye(model.nv)
    assert v == pytest.approx(np.linalg.solve(damped, J.T @ e) / dt, abs=1e-6)
    tracking = ENTRANTS["tracking"].start(case, world).step(world.q0, 1.0, targets, {}).v
    assert np.abs(tracking).max() > 0.1 and v == pytest.approx(tracking, abs=0.01 * np.abs(tracking).max())


def test_speed_caps_and_orientations_of_a_target_one_period_ahead():
    world = world_of("ur5_pole", "tasks.0.type=pose", "tasks.0.max_speed=0.1", "tasks.0.max_turn_rate=0.5")
    (task,) = world.tasks
    here = np.array(pin.SE3(pin.exp3(np.array([0.2, -0.4, 1.0])), np.array([0.1, 0.2, 0.3])).homogeneous)
    turn = np.array([0.3, 0.1, -0.2])
    target = Sample.at((0.4, 0.2, 0.7), pin.exp3(turn) @ here[:3, :3])
    there = target_after_step(task, target, here, 0.01)
    assert (there[:3, 3] - here[:3, 3]) / 0.01 == pytest.approx(0.1 * np.array([0.6, 0.0, 0.8]))
    rate = pin.log3(there[:3, :3] @ here[:3, :3].T) / 0.01
    assert rate == pytest.approx(0.5 * turn / np.linalg.norm(turn))
    near = Sample.at(here[:3, 3] + 0.01, pin.exp3(0.1 * turn) @ here[:3, :3], linear=(0.01, 0.0, 0.0))
    there = target_after_step(task, near, here, 0.01)
    assert (there[:3, 3] - here[:3, 3]) / 0.01 == pytest.approx([0.03, 0.02, 0.02])  # gain 2
    assert pin.log3(there[:3, :3] @ here[:3, :3].T) / 0.01 == pytest.approx(0.2 * turn)


def test_adapter_avoids_static_obstacle(library):
    """An obstacle that rests is kept clear of."""
    score = run_trial(make_case("ur5_pole", "duration=5"), ENTRANTS[library])
    assert score.failed == 0.0 and score.violations == 0.0 and not score.collided
    assert run_trial(make_case("ur5_pole", "duration=5"), ENTRANTS["tracking"]).collided
    # mink asks only not to come nearer, tick by tick, and what is lost to curvature stays lost
    assert score.min_distance > score.d1 - (0.005 if library == "mink" else 1e-3)


def test_adapter_evasion_of_robot_at_rest(library):
    """Records what the libraries do: none knows the obstacle's velocity, mink does not back away, Pink does not see."""
    case, world, pilot = start(library, "ur5_pole")
    targets = {name: sample._replace(linear=np.zeros(3)) for name, sample in targets_at(world, 0.0).items()}
    scene, count = world.scene, len(movable_pairs(world.scene))
    hand = [i for i, (_, b) in enumerate(movable_pairs(scene).tolist()) if b >= len(scene.body_names)]
    assert hand and count > len(hand)
    distances, speeds = [], []
    (tool,) = world.tasks
    data = scene.robot.model.createData()
    pin.framesForwardKinematics(scene.robot.model, data, world.q0)
    tip = data.oMf[tool.frame_id].translation
    for away in (0.30, 0.20, 0.15, 0.12, 0.10, 0.097):
        seen = {"pole": Sample.at(tip + np.array([away, 0.0, 0.0]))}
        v = pilot.step(world.q0, 0.0, targets, seen).v
        distances.append(seen_by(library, pilot, world)[hand].min())
        speeds.append(float(np.abs(v).max()))
    assert np.all(np.diff(distances) < 0.0)
    d1 = case.scenario.avoidance.d1
    assert distances[0] > 0.1 and 0.0 < distances[-1] < d1
    if library == "placo":
        assert speeds[-1] > 0.05
    else:
        assert speeds[-1] == pytest.approx(0.0, abs=1e-6)
    if library == "pink":  # its rows are as old as q: with another q it sees, and backs away
        v = pilot.step(world.q0 + 1e-3, 0.0, targets, seen).v
        assert np.abs(v).max() > 0.05


def test_placo_killed_process_fails_without_hang(placo):
    """A process that is killed makes failures and no hang."""
    case = make_case("ur5_pole", "duration=1")
    world = build_world(case.scenario)
    pilot = ENTRANTS["placo"].start(case, world)

    class Killed:
        def step(self, q, t, targets, obstacles):
            if round(t / case.scenario.dt) == 40:
                os.kill(pilot.worker.process.pid, signal.SIGKILL)
            return pilot.step(q, t, targets, obstacles)

    rollout = roll_out(case, Killed(), world)
    assert rollout.failed[:40].sum() == 0 and rollout.failed[40:].all()
    assert "has ended" in rollout.failure and not rollout.v[40:].any()


def test_placo_silent_process_is_ended(placo, monkeypatch):
    """A process that does not answer is ended."""
    monkeypatch.setattr("qpavoid_bench.arena.libraries.placo_adapter.STEP_TIMEOUT", 0.3)
    _, world, pilot = start("placo", "ur5_pole")
    pilot.worker.process.send_signal(signal.SIGSTOP)
    with pytest.raises(RuntimeError, match=r"did not answer within 0\.3 s"):
        pilot.step(world.q0, 0.0, targets_at(world, 0.0), {})
    assert pilot.seconds >= 0.3
    assert pilot.worker.process.poll() == -signal.SIGKILL
    with pytest.raises(RuntimeError, match="has ended"):
        pilot.step(world.q0, 0.0, targets_at(world, 0.0), {})


def test_placo_interpreter_without_placo_names_remedy(monkeypatch):
    case, world = make_case("ur5_pole"), world_of("ur5_pole")
    monkeypatch.setenv(PLACO_PYTHON, "/nowhere/python")
    assert not ENTRANTS["placo"].missing
    with pytest.raises(ConfigError, match=r"/nowhere/python cannot be run: No such file"):
        ENTRANTS["placo"].start(case, world)
    monkeypatch.setenv(PLACO_PYTHON, "/bin/true")
    with pytest.raises(ConfigError, match=r"/bin/true cannot run placo.*has ended, with code 0; set QPAVOID_PLACO"):
        ENTRANTS["placo"].start(case, world)


def test_adapter_refuses_unsupported_case():
    """What an adapter does not know is refused at the start."""
    posture = make_case("ur5_pole", "tasks=[{frame: tool0}, {type: posture}]")
    with pytest.raises(ConfigError, match=r"adapter of Pink knows no tasks other than `position`, `pose`"):
        frame_tasks(posture, build_world(posture.scenario), "Pink")
    cloud = make_case("ur5_pole", "obstacles.0.shape={type: point_cloud, resolution: 0.05}")
    with pytest.raises(ConfigError, match="knows no point clouds"):
        frame_tasks(cloud, build_world(cloud.scenario), "placo")
    free = make_case("g1_reach_across", "lock=[]")
    with pytest.raises(ConfigError, match="neither hinges nor slides; lock them"):
        frame_tasks(free, build_world(free.scenario), "placo")
