"""The link of the live view: the loop never waits, whatever becomes of the page; no browser and no viser needed."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from qpavoid import Controller, Sample, load_scenario
from qpavoid.errors import ConfigError
from qpavoid.viz import view as view_module
from qpavoid.viz.view import View, status_text
from qpavoid.viz.view_drag import Pulled
from qpavoid.viz.view_link import frame_of, make_link, pack, received, send, send_event, unpack


@pytest.fixture(scope="module")
def tick():
    controller, q = Controller.from_scenario(load_scenario("panda_line", ["avoidance.d2=0.3"]))
    return controller.tick(q, 2.5)


@pytest.fixture
def link():
    ends = make_link()
    yield ends
    for end in ends:
        end.close()


def test_frame_survives_the_link(tick, link):
    frame = frame_of(tick, "**SOLVED** µm")
    ours, other = link
    assert send(ours, pack(frame))
    (datagram,) = received(other)
    for part, copy in zip(frame, unpack(datagram), strict=True):
        np.testing.assert_array_equal(part, copy)


def test_frame_says_what_the_step_computed(tick):
    frame = frame_of(tick)
    np.testing.assert_array_equal(frame.witnesses[:, 0], tick.proximity.distance)
    segments = frame.witnesses[:, 1:4] - frame.witnesses[:, 4:]
    np.testing.assert_allclose(np.linalg.norm(segments, axis=1), np.abs(frame.witnesses[:, 0]), atol=1e-9)
    np.testing.assert_allclose(frame.levels, (0.02, 0.3))  # of the scenario, which has no offset
    names = load_scenario("panda_line").obstacles
    ball = [obstacle.name for obstacle in names].index("ball")
    assert frame.obstacles[ball, 9] < 0.85  # it has been on its way for half a second
    np.testing.assert_allclose(frame.obstacles[ball, 10:], (-0.12, 0.24))


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
    text = status_text(tick)
    nearest = tick.problem.pair_names[tick.proximity.pair[np.argmin(tick.proximity.distance)]]
    assert all(name in text for name in nearest)
    assert text.startswith("**SOLVED**")


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
