"""The live view in a real browser: it loads, plays, is dragged about and changes the solver, and the loop does it."""

import os
import shutil
import threading
import time
from contextlib import contextmanager
from io import BytesIO

import numpy as np
import pytest

from qpavoid import Robot, load_scenario, simulate
from qpavoid.setup.pairs import pair_reasons, reasons_in_words
from qpavoid.viz.view_replay import Replay
from qpavoid.viz.view_robot import RobotPage
from qpavoid.viz.view_session import Session

REQUIRED = bool(os.environ.get("QPAVOID_REQUIRE_BROWSER"))
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if not REQUIRED:
    for module in ("viser", "trimesh", "collada", "playwright", "PIL"):
        pytest.importorskip(module)
    if CHROMIUM is None:
        pytest.skip("no chromium; QPAVOID_REQUIRE_BROWSER=1 makes that a failure", allow_module_level=True)

WIDTH, HEIGHT, FIELD_OF_VIEW = 960, 640, np.radians(75.0)
PATIENCE = 60.0
"""Longest wait for the page or the loop [s]: a machine without a graphics processor may be busy with other tests."""
SCENARIO = """\
robot: panda
tasks:
  - frame: panda_hand_tcp
    type: position
    max_speed: 0.5
    motion: {type: fixed, position: [0.45, 0.0, 0.55]}
obstacles:
  - name: ball
    shape: {type: sphere, radius: 0.12}
    motion: {type: fixed, position: [0.3, 0.45, 0.35]}
avoidance: {d1: 0.03, d2: 0.12}
solver: qp
dt: 0.02
duration: 10
"""


def wait_for(condition, what):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.05)


def pixel(view, point, box):
    """Where the page shows a point (3,) at first: x, y on the screen."""
    forward = view.look_at - view.camera
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    offset, scale = point - view.camera, 0.5 * box["height"] / np.tan(0.5 * FIELD_OF_VIEW)
    x, y = (scale * (offset @ axis) / (offset @ forward) for axis in (right, np.cross(right, forward)))
    return box["x"] + 0.5 * box["width"] + x, box["y"] + 0.5 * box["height"] - y


def drag(page, begin, shift):
    """Drag from one pixel by a number of pixels (2,)."""
    page.mouse.move(*begin)
    page.mouse.down()
    for part in np.linspace(0.1, 1.0, 12):
        page.mouse.move(begin[0] + part * shift[0], begin[1] + part * shift[1])
        time.sleep(0.04)
    page.mouse.up()


def choose(page, old, new):
    """Choose another entry in the first list that shows one."""
    page.locator(f"input[value='{old}']").first.click()
    page.get_by_role("option", name=new, exact=True).first.click()


def picture(page):
    """What the canvas shows, but for messages in its upper part and the panel."""
    from PIL import Image

    image = Image.open(BytesIO(page.screenshot(timeout=1e3 * PATIENCE))).convert("RGB")
    return np.asarray(image, dtype=float)[160:, : WIDTH - 330]


@contextmanager
def running(shown):
    """Run what a page shows in a thread of its own, and see it end."""
    is_done = threading.Event()
    loop = threading.Thread(target=shown.run, args=(is_done.is_set,))
    loop.start()
    try:
        yield shown
    finally:
        is_done.set()
        loop.join(PATIENCE)
        assert not shown.view.is_alive


def visit(page, shown):
    wait_for(lambda: shown.view.url, "the page's address")
    page.goto(shown.view.url)
    page.wait_for_selector("canvas")


@pytest.fixture
def session(tmp_path):
    file = tmp_path / "pull.yaml"
    file.write_text(SCENARIO)
    with running(Session(str(file), port=0, quality="low")) as session:
        yield session


@pytest.fixture
def page():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(1e3 * PATIENCE)
        yield page
        browser.close()


@pytest.fixture
def empty_picture(page, session):
    """A page with nothing on it but the ground, from the same camera."""
    import viser

    server = viser.ViserServer(port=0, verbose=False)
    server.initial_camera.position, server.initial_camera.look_at = session.view.camera, session.view.look_at
    server.scene.set_up_direction("+z")
    server.scene.add_grid("/grid", 6.0, 6.0, cell_size=0.25)
    page.goto(f"http://127.0.0.1:{server.get_port()}")
    page.wait_for_selector("canvas")
    time.sleep(2.0)
    empty = picture(page)
    server.stop()
    return empty


@pytest.mark.xdist_group("browser")
def test_page_shows_and_steers_a_run(session, page, empty_picture):
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    visit(page, session)
    page.get_by_text("rows").first.wait_for()
    page.get_by_text("Drag the ball into the robot").wait_for()
    wait_for(lambda: session.t > 0.1, "the first steps: a run begins with the first browser")
    tool = session.tick.kinematics.position[0]

    # the page is not empty: robot and ball cover a good part of what the ground alone shows
    changed = 0.0
    end = time.monotonic() + PATIENCE
    while changed < 0.05 and time.monotonic() < end:
        changed = np.mean(np.abs(picture(page) - empty_picture).max(axis=2) > 24.0)
    assert changed > 0.05

    # pause and play
    page.get_by_role("button", name="pause").click()
    wait_for(lambda: not session.clock.is_playing, "the pause")
    steps = session.t
    page.get_by_role("button", name="step", exact=True).click()
    wait_for(lambda: session.t > steps, "a single step")
    page.get_by_role("button", name="play", exact=True).click()
    wait_for(lambda: session.t > steps + 0.1, "the run to go on")

    # another solver, built aside, and a second robot
    choose(page, "qp", "eq10")
    wait_for(lambda: session.config.solver.label == "eq10", "the other solver")
    assert session.t > steps
    assert not page.locator(".u-label", has_text="beside").count()  # no curve of a robot that is not there
    choose(page, "none", "tracking")
    wait_for(lambda: len(session.loops) == 2, "the robot beside")
    page.locator(".u-label", has_text="beside").wait_for()
    choose(page, "eq10", "qp")
    wait_for(lambda: session.config.solver.label == "qp", "the first solver")

    # the target, by its arrow that points up; the robot follows
    wait_for(lambda: np.linalg.norm(tool_error(session)) < 0.01, "the robot at its target")
    box, target = page.locator("canvas").first.bounding_box(), session.tick.targets[0].position.copy()
    drag(page, pixel(session.view, target + np.array([0.0, 0.0, 0.14]), box), (0.0, -50.0))
    wait_for(lambda: session.tick.targets[0].position[2] > target[2] + 0.03, "the target")
    wait_for(lambda: np.linalg.norm(tool_error(session)) < 0.01, "the robot at the pulled target")
    tool = session.tick.kinematics.position[0]
    assert tool[2] > target[2] + 0.03

    # the ball itself
    ball = ball_position(session)
    drag(page, pixel(session.view, ball, box), (60.0, 0.0))
    wait_for(lambda: np.linalg.norm(ball_position(session) - ball) > 0.05, "the ball")

    # an obstacle is added, and another one removed
    page.get_by_role("button", name="add", exact=True).click()
    wait_for(lambda: "ball 1" in session.controller.scene.obstacle_names, "the new obstacle")
    assert "ball 1" in session.loops[1].controller.scene.obstacle_names
    page.get_by_role("button", name="remove", exact=True).click()
    wait_for(lambda: len(session.controller.scene.obstacle_names) == 1, "one obstacle less")

    # what was, and on from there
    now = session.t
    page.get_by_role("button", name="pause").click()
    wait_for(lambda: not session.clock.is_playing, "the pause")
    page.get_by_label("look back [s]").or_(page.get_by_role("slider").first).first.focus()
    page.keyboard.press("End")
    wait_for(lambda: session.shown_time < now - 0.5, "the past")
    page.get_by_role("button", name="play", exact=True).click()
    wait_for(lambda: session.shown_time > now, "the present")

    # what is pulled while time stands still is there when it goes on
    page.get_by_role("button", name="pause").click()
    wait_for(lambda: not session.clock.is_playing, "the pause")
    now, index = session.t, [o.name for o in session.controller.scene.slots].index("ball 1")
    place = session.tick.obstacles[index, 9:].copy()
    drag(page, pixel(session.view, place, box), (0.0, 50.0))
    time.sleep(1.0)
    assert session.t == now
    page.get_by_role("button", name="play", exact=True).click()
    wait_for(lambda: np.linalg.norm(session.tick.obstacles[index, 9:] - place) > 0.02, "the pulled obstacle")

    # a second browser, one that is closed, and one that loads the page again
    other = page.context.browser.new_page()
    other.goto(session.view.url)
    wait_for(lambda: session.view.clients == 2, "the second browser")
    other.close()
    wait_for(lambda: session.view.clients == 1, "one browser less")
    page.reload()
    page.wait_for_selector("canvas")
    wait_for(lambda: session.view.clients == 1, "the page, once more")
    steps = session.t
    wait_for(lambda: session.t > steps + 0.1, "the run to go on")
    assert not errors


@pytest.mark.xdist_group("browser")
def test_page_plays_logs(page):
    logs = [simulate(load_scenario("panda_ball", ["duration=2.4", "dt=0.02"], name)) for name in ("tracking", "qp")]
    with running(Replay(logs, port=0, quality="low")) as replay:
        visit(page, replay)
        wait_for(lambda: replay.step > 2, "the first steps")
        choose(page, "panda_ball tracking", "panda_ball qp")
        wait_for(lambda: replay.frames.log is logs[1], "the other run")
        page.get_by_role("button", name="closest", exact=True).click()
        wait_for(lambda: not replay.clock.is_playing, "the closest moment")
        assert replay.step == np.argmin(logs[1].min_distance)
        page.get_by_text(f"at {logs[1].t[replay.step]:.2f} s").first.wait_for()


@pytest.mark.xdist_group("browser")
def test_page_moves_a_robot_by_hand(page):
    robot = Robot.load("panda")
    with running(RobotPage(robot, reasons_in_words(pair_reasons(robot)), port=0, quality="low")) as shown:
        visit(page, shown)
        page.get_by_text(f"{len(robot.bodies.collisionPairs)} active pairs").first.wait_for()
        page.get_by_text("pairs left out: one joint apart").first.wait_for()
        assert not shown.touching
        page.get_by_role("slider").nth(1).focus()
        page.keyboard.press("End")  # bent over, into its base
        wait_for(lambda: {"panda_link0_0", "panda_link5_0"} <= shown.touching, "bodies in contact")
        assert shown.q[1] == pytest.approx(robot.bounds().upper[1], abs=1e-2)
        red = 0.0
        end = time.monotonic() + PATIENCE
        while red < 0.003 and time.monotonic() < end:
            pixels = picture(page)
            red = np.mean((pixels[..., 0] > 1.4 * pixels[..., 1]) & (pixels[..., 0] > 1.4 * pixels[..., 2]))
        assert red > 0.003


def tool_error(session):
    return session.tick.kinematics.position[0] - session.tick.targets[0].position


def ball_position(session):
    number = [obstacle.name for obstacle in session.controller.scene.slots].index("ball")
    return session.tick.obstacles[number, 9:].copy()
