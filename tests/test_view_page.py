"""The page's process: who can see it, which port it takes, and that it stays small; a client that only reads."""

import socket
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from qpavoid import Controller, Obstacle, load_scenario
from qpavoid.config import Sphere
from qpavoid.viz.view import View
from qpavoid.viz.view_build import Loop, build_runs

pytest.importorskip("viser")
pytest.importorskip("trimesh")
pytest.importorskip("collada")
from qpavoid_bench.endurance.reader import reader

PATIENCE = 60.0
HOUR = 3600 * 30
"""Frames of an hour."""


def wait_for(condition, what):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def controller_and_q():
    config = load_scenario("panda_ball").model_copy(update={"spare_obstacles": 2})
    return Controller.from_scenario(config)


def test_page_runs_a_law_of_ones_own_beside_another(tmp_path):
    (tmp_path / "laws.py").write_text("def third(problem):\n    return problem.v_tracking / 3\n")
    runs = build_runs("panda_line", ["dt=0.02"], [f"{tmp_path / 'laws.py'}:third", "tracking"], set())
    slow, fast = (Loop(controller, runs.q0, runs.config).look(0.6, {}, {}) for controller in runs.controllers)
    assert np.abs(fast.solution.v).max() > 1e-4
    np.testing.assert_allclose(3 * slow.solution.v, fast.solution.v, atol=1e-9)


@contextmanager
def shown(controller, q, **options):
    with View(controller.scene, ["panda_hand_tcp"], **options) as view:
        end = time.monotonic() + PATIENCE
        while not view.url:
            view.update(controller.tick(q))
            assert time.monotonic() < end and view.is_alive
            time.sleep(0.02)
        yield view, int(view.url.rsplit(":", 1)[1])


def resident(pid):
    """Memory of a process [MB]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 1e6


def test_busy_port_is_passed_over_and_only_this_machine_is_served(controller_and_q, capfd):
    controller, q = controller_and_q
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        taken = busy.getsockname()[1]
        with shown(controller, q, port=taken) as (view, port):
            assert port != taken
            said = capfd.readouterr().err
            assert f"port {taken} is taken" in said
            assert view.url in said
            others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
            for address in others - {"127.0.0.1", "127.0.1.1"}:
                with socket.socket() as client, pytest.raises(OSError):
                    client.settimeout(2.0)
                    client.connect((address, port))


def run_frames(controller, q, count, samples):
    """Resident memory of the page's process [MB] along a number of frames that one reader gets."""
    with shown(controller, q, port=0, rate=2000.0) as (view, port), reader(port) as messages:
        wait_for(lambda: view.update(controller.tick(q)) or view.clients == 1, "the reader")
        tick, sizes = controller.tick(q), []
        sway, ball = np.random.default_rng(0).uniform(0.0, 0.1, len(q)), [o.name for o in controller.scene.slots]
        ball = ball.index("ball")
        for k in range(count):
            t = k / 30.0
            obstacles = tick.obstacles.copy()
            obstacles[ball, 9:] += 0.3 * np.sin(t)
            state = tick.state._replace(q=q + sway * np.sin(t), t=t)
            view.show(view.frame(tick._replace(state=state, obstacles=obstacles)))
            if k % (count // samples) == 0:
                sizes.append(resident(view.pid))
            if k % 40 == 0:  # obstacles come and go, too
                controller.add_obstacle(Obstacle.at("visitor", Sphere(radius=0.05), [0.8, 0.0, 0.2]))
            elif k % 40 == 20:
                controller.remove_obstacle("visitor")
            time.sleep(0.003)  # so that most of them are shown
        assert view.is_alive
    return np.array(sizes), messages[0]


def test_page_stays_small_while_it_is_read(controller_and_q):
    sizes, messages = run_frames(*controller_and_q, 3000, 20)
    assert messages > 20  # a busy machine sends fewer of them
    assert sizes[-1] < sizes[10] + 5.0, sizes


@pytest.mark.slow
def test_page_stays_small_for_an_hour(controller_and_q):
    """An hour of frames, 30 a second, as fast as they are shown."""
    sizes, _ = run_frames(*controller_and_q, HOUR, 60)
    print(f"resident: {sizes[0]:.1f} MB, half way {sizes[30]:.1f} MB, in the end {sizes[-1]:.1f} MB")
    assert sizes[-1] < sizes[30] + 5.0


def test_second_reader_and_one_that_leaves(controller_and_q):
    controller, q = controller_and_q
    with shown(controller, q, port=0) as (view, port):

        def counts(number):
            return lambda: view.update(controller.tick(q)) or view.clients == number

        with reader(port) as first:
            wait_for(counts(1), "the first reader")
            with reader(port) as second:
                wait_for(counts(2), "the second reader")
                wait_for(lambda: second[0] > 0, "what is shown")
            wait_for(counts(1), "the second one to have left")
            received = first[0]
            tick = controller.tick(q)
            view.show(view.frame(tick._replace(state=tick.state._replace(q=q + 0.1))))
            wait_for(lambda: first[0] > received, "another frame")
        wait_for(counts(0), "both to have left")
