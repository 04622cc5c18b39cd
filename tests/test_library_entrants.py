"""Adapters of other libraries: each sees what this library sees, and is asked for what its tasks ask for."""

import os
import signal
import sys
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import Controller, Sample, load_scenario
from qpavoid.errors import ConfigError
from qpavoid_bench.arena.case import Case, Sensor
from qpavoid_bench.arena.entrants import ENTRANTS
from qpavoid_bench.arena.families import load_family
from qpavoid_bench.arena.families import make_case as make_family_case
from qpavoid_bench.arena.library_pilot import (
    DAMPING,
    LibraryPilot,
    frame_tasks,
    movable_pairs,
    target_after_step,
)
from qpavoid_bench.arena.rollout import roll_out
from qpavoid_bench.arena.trial import run_trial
from qpavoid_bench.arena.world import build_world
from qpavoid_bench.libraries import LIBRARIES, environments

pytest.importorskip("mujoco")

SCENARIOS = ["ur5_pole", "panda_line", "crossing_arms", "g1_reach_across"]
NO_HULLS = ("roboplan", "embodik", "drake")


@pytest.fixture(params=list(LIBRARIES))
def library(request):
    if not LIBRARIES[request.param].is_installed:
        pytest.skip(f"{request.param} has no environment yet")
    return request.param


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


@pytest.mark.parametrize("name", SCENARIOS)
def test_adapter_frames_and_distances_equal_scene(library, name):
    """Frames and distances are ours, with obstacles where they are said to be."""
    if library in NO_HULLS and name in ("ur5_pole", "g1_reach_across"):
        with pytest.raises(ConfigError, match="a Convex cannot be"):
            start(library, name)
        return
    _, world, pilot = start(library, name, *(["robot=panda-capsules"] if name == "panda_line" else []))
    model, t = world.scene.robot.model, 2.5
    q = pin.integrate(model, world.q0, 0.1 * np.random.default_rng(1).uniform(-1.0, 1.0, model.nv))
    moved = {o.name: o.motion.sample(t) for o in world.scene.obstacles if o.moves and library != "embodik"}
    pilot.step(q, t, targets_at(world, 0.0), moved)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    frames, reported = pilot.observe(q)
    assert frames == pytest.approx(np.array([data.oMf[task.frame_id].homogeneous for task in world.tasks]), abs=1e-6)
    truth, known = true_distances(world, q, moved), ~np.isnan(reported)
    assert known.all() or library in NO_HULLS  # these do not tell of all pairs, or of none
    apart = known & (truth > 0.0)  # relative: cylinders and hulls are iterated on, to such a tolerance
    assert apart.sum() >= 0.9 * known.sum()
    assert reported[apart] == pytest.approx(truth[apart], rel=4e-6, abs=3e-5 if library == "drake" else 2e-6)


@pytest.mark.parametrize("kind", ["position", "pose"])
@pytest.mark.parametrize("name", ["mink", "placo"])
def test_adapter_velocity_equals_damped_inverse_without_obstacles(name, kind):
    """With nothing near the velocity is the damped inverse of our task rows; others regularise more."""
    if not LIBRARIES[name].is_installed:
        pytest.skip(f"{name} has no environment yet")
    case, world, pilot = start(name, "ur5_pole", "obstacles=[]", f"tasks.0.type={kind}")
    ours = Controller(world.scene, world.tasks, "tracking", case.scenario.dt)
    for t in (0.5, 1.0, 2.0):
        targets = targets_at(world, t)
        A, b = ours.tick(world.q0, t, targets).problem.tracking[:2]
        v = A.T @ np.linalg.solve(A @ A.T + DAMPING**2 * np.eye(len(A)), b)
        assert np.abs(v).max() > 0.1
        assert pilot.step(world.q0, t, targets, {}).v == pytest.approx(v, abs=1e-6)


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
    """A plate across the way is not touched, which tracking alone would."""
    case = make_family_case(load_family("behind_plate"), 0)
    score = run_trial(case, ENTRANTS[library])
    assert score.failed < 0.05 and not score.collided, score.failure
    assert run_trial(case, ENTRANTS["tracking"]).collided
    assert score.min_distance > score.d1 - 0.01  # what is lost to curvature; mink asks for no motion away


def any_library():
    for library in LIBRARIES.values():
        if library.is_installed:
            return library
    pytest.skip("no library has an environment yet")


def test_a_killed_process_fails_without_hang():
    case = make_case("ur5_pole", "duration=1")
    world = build_world(case.scenario)
    pilot = LibraryPilot(any_library(), case, world)

    class Killed:
        def step(self, q, t, targets, obstacles):
            if round(t / case.scenario.dt) == 40:
                os.kill(pilot.process.process.pid, signal.SIGKILL)
            return pilot.step(q, t, targets, obstacles)

    rollout = roll_out(case, Killed(), world)
    assert rollout.failed[:40].sum() == 0 and rollout.failed[40:].all()
    assert "has ended" in rollout.failure and not rollout.v[40:].any()


def test_a_silent_process_is_ended():
    case = make_case("ur5_pole")
    world = build_world(case.scenario)
    pilot = LibraryPilot(any_library(), case, world)
    pilot.timeout = 0.3
    pilot.process.process.send_signal(signal.SIGSTOP)
    with pytest.raises(RuntimeError, match=r"did not answer within 0\.3 s"):
        pilot.step(world.q0, 0.0, targets_at(world, 0.0), {})
    assert pilot.seconds >= 0.3
    assert pilot.process.process.poll() == -signal.SIGKILL
    with pytest.raises(RuntimeError, match="has ended"):
        pilot.step(world.q0, 0.0, targets_at(world, 0.0), {})


def test_an_environment_that_cannot_be_made_is_named(tmp_path, monkeypatch):
    """No such wheel, nothing left behind; and the entrant says so."""
    monkeypatch.setenv(environments.FOLDER_VARIABLE, str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(ConfigError, match=r"placo: pip cannot install placo==0\.10\.2: ERROR: No matching"):
        LIBRARIES["placo"].interpreter()
    assert not LIBRARIES["placo"].is_installed and [path.suffix for path in tmp_path.iterdir()] == [".lock"]
    assert ENTRANTS["placo"].missing == ("placo==0.10.2",)
    assert "pip cannot install" in ENTRANTS["placo"].prepare()


def test_an_environment_is_made_once(tmp_path, monkeypatch):
    monkeypatch.setenv(environments.FOLDER_VARIABLE, str(tmp_path))
    place = environments.folder("mine", ("a==1",))
    (place / "bin").mkdir(parents=True)
    (place / "bin" / "python").symlink_to(sys.executable)
    (place / "complete").touch()
    assert environments.interpreter("mine", ("a==1",)) == place / "bin" / "python"
    assert not environments.is_made("mine", ("a==2",))


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
