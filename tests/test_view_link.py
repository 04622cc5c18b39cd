"""The link of the live view: the loop never waits, whatever becomes of the page; no browser and no viser needed."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from qpavoid import Controller, Sample, load_scenario
from qpavoid.control.scenario import build_parts
from qpavoid.errors import ConfigError
from qpavoid.run.simulate import Follower
from qpavoid.viz import view as view_module
from qpavoid.viz.meshes import of_obstacle
from qpavoid.viz.view import View
from qpavoid.viz.view_drag import Pulled
from qpavoid.viz.view_link import (
    BACKUP,
    SlotChange,
    bodies_in_contact,
    frame_of,
    make_link,
    obstacles_of_pairs,
    pack,
    pack_change,
    received,
    send,
    send_event,
    still_frame,
    unpack,
)
from qpavoid.viz.view_status import status_html


@pytest.fixture(scope="module")
def controller_and_q():
    return Controller.from_scenario(load_scenario("panda_line", ["avoidance.d2=0.3"]))


@pytest.fixture(scope="module")
def scene(controller_and_q):
    return controller_and_q[0].scene


@pytest.fixture(scope="module")
def tick(controller_and_q):
    controller, q = controller_and_q
    return controller.tick(q, 2.5)


@pytest.fixture(scope="module")
def frame(tick, scene):
    return frame_of(tick, scene.robot, obstacles_of_pairs(scene), "<b>SOLVED</b> µm")


@pytest.fixture
def link():
    ends = make_link()
    yield ends
    for end in ends:
        end.close()


def test_frame_survives_the_link(frame, link):
    ours, other = link
    assert send(ours, pack(frame))
    (datagram,) = received(other)
    for part, copy in zip(frame, unpack(datagram), strict=True):
        np.testing.assert_array_equal(part, copy)


def test_large_mesh_of_a_new_obstacle_fits_into_the_link(link):
    corners = np.random.default_rng(0).uniform(-0.3, 0.3, (20_000, 3, 3))
    mesh = of_obstacle({"name": "rock", "shape": {"type": "mesh"}, "triangles": corners.reshape(-1).tolist()}, 0)
    ours, other = link
    assert send(ours, pack_change(SlotChange(3, "rock", mesh)))
    (datagram,) = received(other)
    change = unpack(datagram)
    assert (change.slot, change.name) == (3, "rock")
    assert 0 < len(change.mesh.faces) < len(mesh.faces)
    np.testing.assert_allclose(np.abs(change.mesh.vertices).max(), 0.3, atol=0.05)


def test_frame_says_what_the_step_computed(tick, frame, scene):
    np.testing.assert_array_equal(frame.witnesses[:, 0], tick.proximity.distance)
    segments = frame.witnesses[:, 1:4] - frame.witnesses[:, 4:7]
    np.testing.assert_allclose(np.linalg.norm(segments, axis=1), np.abs(frame.witnesses[:, 0]), atol=1e-9)
    np.testing.assert_allclose(frame.levels, (0.02, 0.3))  # of the scenario, which has no offset
    names = load_scenario("panda_line").obstacles
    ball = [obstacle.name for obstacle in names].index("ball")
    assert frame.obstacles[ball, 9] < 0.85  # it has been on its way for half a second
    np.testing.assert_allclose(frame.obstacles[ball, 10:], (-0.12, 0.24))
    for pair, number in zip(tick.proximity.pair, frame.witnesses[:, 7].astype(int), strict=True):
        body = scene.slots[number].name if number >= 0 else scene.pair_names[pair][1]
        assert body in scene.pair_names[pair]
        assert (number >= 0) == bool({"ball", *scene.obstacle_names} & {*scene.pair_names[pair]})


def test_bodies_that_touch_are_those_of_pairs_in_contact(scene):
    pair = 5
    numbers = bodies_in_contact(scene, np.array([pair]), np.array([-1e-3]))
    names = {scene.body_names[int(number)] for number in numbers}
    assert names == {*scene.pair_names[pair]} & {*scene.body_names}
    assert not len(bodies_in_contact(scene, np.array([pair]), np.array([1e-3])))


def test_ghosts_end_where_the_backup_trajectory_ends():
    controller, q = Controller.from_scenario(load_scenario("panda_ball"))
    follower, ghosts = Follower(controller.scene.robot.model, q, 0.0, controller.dt), []
    for k in range(220):  # the ball is near
        tick = controller.tick(follower.q, k * controller.dt)
        if len(tick.backup):
            ghosts = frame_of(tick, controller.scene.robot, obstacles_of_pairs(controller.scene)).ghosts
            end = follower.q + tick.backup.sum(axis=0)
            np.testing.assert_allclose(ghosts[-1, 2:], end, atol=1e-12)
            assert np.all(ghosts[:, 0] == BACKUP)
        follower.follow(tick.solution.v)
    assert len(ghosts)


def test_full_queue_drops_frames(link):
    ours, other = link
    sent = [send(ours, bytes(2000)) for _ in range(5000)]
    assert sent[0]
    assert not sent[-1]
    assert len(list(received(other))) == sum(sent)
    assert send(ours, b"again")


def test_dead_page_drops_frames(link):
    ours, other = link
    other.close()
    assert not send(ours, b"frame")
    assert not send_event(ours, type="play")
    assert list(received(ours)) == []


def test_status_names_the_closest_pair(tick):
    text = status_html(tick, [1e-4, 3e-4, 2e-4])
    nearest = tick.problem.pair_names[tick.proximity.pair[np.argmin(tick.proximity.distance)]]
    assert all(name in text for name in nearest)
    assert "SOLVED" in text
    assert "step 0.2 ms" in text
    assert "step 120 ms, p99 120 ms" in status_html(tick, [0.12] * 3)


def test_scene_is_shown_before_there_is_a_controller():
    """The robot at its start, obstacles as at t = 0, and no status, so that the page says what it waits for."""
    config = load_scenario("panda_drag")
    parts = build_parts(config)
    shown = still_frame(parts.scene, parts.tasks, parts.q0, config.avoidance)
    frame = unpack(pack(shown))
    np.testing.assert_array_equal(frame.q, parts.q0)
    assert frame.text == "" and not len(frame.witnesses)
    names = [obstacle.name for obstacle in parts.scene.slots]
    np.testing.assert_array_equal(frame.obstacles[names.index("ball"), 9:], config.obstacles[0].motion.position)


def test_missing_viser_is_one_line_with_a_remedy(monkeypatch, panda):
    from qpavoid import build_scene

    monkeypatch.setattr(view_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'qpavoid\[view\]'"):
        View(build_scene(panda))


def test_pulled_body_follows_with_the_velocity_it_has():
    pose = np.r_[np.eye(3).ravel(), 0.5, 0.0, 0.3]
    pulled, dt, goal = Pulled(pose), 0.01, np.array([0.9, 0.4, 0.3])
    pulled.pull(Sample.at(goal))
    positions, speeds = [], []
    for _ in range(300):
        before = pulled.sample.position.copy()
        pulled.advance(dt)
        np.testing.assert_allclose(pulled.sample.linear * dt, pulled.sample.position - before, atol=1e-12)
        positions.append(pulled.sample.position.copy())
        speeds.append(np.linalg.norm(pulled.sample.linear))
    assert max(speeds) <= 1.0 + 1e-9
    np.testing.assert_allclose(positions[-1], goal, atol=1e-6)
    distances = np.linalg.norm(np.array(positions) - goal, axis=1)
    assert np.all(np.diff(distances) <= 1e-12)  # it never passes beyond


USER_SCRIPT = """
    import os, signal, time
    from qpavoid import Controller, load_scenario
    from qpavoid.viz.view import View

    controller, q = Controller.from_scenario(load_scenario("panda_line"))
    view = View(controller.scene, port=0)
    end = time.monotonic() + 120.0
    while not view.url and view.is_alive and time.monotonic() < end:
        view.update(controller.tick(q))
        time.sleep(0.05)
    print(view.url.startswith("http://127.0.0.1:"), view.clients)
    os.kill(view.pid, signal.SIGKILL)
    while view.is_alive:
        time.sleep(0.01)
    for _ in range(200):
        view.update(controller.tick(q))
    print(view.is_alive, view.events())
"""


def test_script_without_a_main_guard_survives_the_death_of_its_page():
    pytest.importorskip("viser")
    pytest.importorskip("trimesh")
    script = textwrap.dedent(USER_SCRIPT)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:2] == ["True 0", "False []"]
    assert "view: http://127.0.0.1:" in done.stderr
