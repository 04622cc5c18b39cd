"""The service: a controller's own velocities; what is wrong is refused by name; lost clients end in a stop."""

import copy
import threading
import time

import numpy as np
import pinocchio as pin
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qpavoid import ConfigError, Controller, Points, Pose, Sample, load_scenario
from qpavoid.solvers.python_file import scenario_with_law

msgpack, zmq = pytest.importorskip("msgpack"), pytest.importorskip("zmq")

from qpavoid.service.messages import MAX_FRAME, MAX_MESSAGE, Fault  # noqa: E402
from qpavoid.service.server import Service  # noqa: E402

TOOL, DT, HEARTBEAT = "panda_hand_tcp", 0.01, 10.0
SCENARIO = {
    "robot": "panda", "duration": 1.0, "dt": DT, "spare_obstacles": 2,
    "tasks": [{"frame": TOOL, "motion": {"type": "fixed"}}, {"type": "posture", "weight": 1e-3}],
    "obstacles": [
        {"name": "ball", "shape": {"type": "sphere", "radius": 0.06},
         "motion": {"type": "fixed", "position": [0.6, 0, 0.5]}},
        {"name": "camera", "shape": {"type": "point_cloud"}, "motion": {"type": "fixed", "position": [0, 0, 0]}},
        {"name": "cup", "shape": {"type": "sphere", "radius": 0.03}, "graspable": True,
         "motion": {"type": "fixed", "position": [0.3, 0.8, 0.3]}},
    ],
    "avoidance": {"d1": 0.02, "d2": 0.1, "backup": False},
}  # fmt: skip


class Client:
    """One end of a connection; an answer that does not come fails the test."""

    def __init__(self, endpoint, kind=zmq.DEALER):
        self.context = zmq.Context()
        self.socket = self.context.socket(kind)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVTIMEO, 60_000)
        self.socket.connect(endpoint)

    def raw(self, *frames):
        self.socket.send_multipart(frames)
        return msgpack.unpackb(self.socket.recv())

    def ask(self, kind, *clouds, **fields):
        return self.raw(msgpack.packb({"version": 1, "type": kind, **fields}), *clouds)

    def close(self):
        self.context.destroy(0)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("service") / "served.yaml"
    path.write_text(yaml.safe_dump(SCENARIO))
    return load_scenario(str(path))


@pytest.fixture
def serve(scenario):
    """Begins a service in a thread; gives it, and clients of it."""
    running, clients = [], []

    def begin(heartbeat=HEARTBEAT, served=scenario, motions=False, law=None):
        service = Service(served, heartbeat, port=0, follows_motions=motions, law=law)
        thread = threading.Thread(target=service.run)
        thread.start()
        running.append((service, thread))

        def client(kind=zmq.DEALER):
            clients.append(Client(service.endpoint, kind))
            return clients[-1]

        return service, client

    yield begin
    for service, thread in running:
        service.end()
        thread.join(30)
        assert not thread.is_alive()
        service.close()
    for client in clients:
        client.close()


def listener(service, client):
    """A subscriber of the commands."""
    commands_in = client(zmq.SUB)
    commands_in.socket.setsockopt(zmq.SUBSCRIBE, b"")
    commands_in.socket.connect(service.commands_endpoint)
    return commands_in


def test_answers_are_the_controllers_own(serve, scenario):
    """Targets, obstacles with and without velocity, a cloud, a measured velocity, a filtered command."""
    controller, q = Controller.from_scenario(scenario)
    rng, ask = np.random.default_rng(0), serve()[1](zmq.REQ).ask
    assert ask("reset", seq=3) == {"version": 1, "type": "done", "seq": 3}
    turn = pin.Quaternion(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3))
    for k in range(40):
        t, place = k * DT, np.array([0.45 - 0.002 * k, 0.1, 0.5])
        ball = Sample.at(place, turn.toRotationMatrix(), linear=[-0.2, 0.0, 0.0])  # turned as it was sent before
        sent = {"position": place.tolist(), "linear": [-0.2, 0.0, 0.0]}
        if k % 3 == 0:
            ball, sent = Pose.at(place, turn.toRotationMatrix(), t=t - 0.005), {
                "position": place.tolist(), "quaternion": turn.coeffs().tolist(), "t": t - 0.005,
            }  # fmt: skip
        cloud = rng.uniform([0.4, -0.3, 0.0], [0.8, -0.2, 0.8], (200, 3)).astype("<f4")
        target = [0.35, 0.2, 0.45]
        if k == 25:
            v_desired = rng.uniform(-1, 1, 7)
            mine = controller.filter(q, v_desired, t, {"ball": ball})
            theirs = ask("filter", seq=k, q=q.tolist(), t=t, v_desired=v_desired.tolist(), obstacles={"ball": sent})
        else:
            mine = controller.step(
                q, t, {TOOL: target, "posture": controller.scene.robot.home},
                {"ball": ball, "camera": Points(cloud.astype(float))}, v=np.zeros(7) if k == 0 else None,
            )  # fmt: skip
            theirs = ask(
                "step", cloud.tobytes(), seq=k, q=q.tolist(), t=t, **({"v": [0.0] * 7} if k == 0 else {}),
                targets={TOOL: {"position": target}, "posture": {"q": controller.scene.robot.home.tolist()}},
                obstacles={"ball": sent, "camera": {"points": 0}},
            )  # fmt: skip
        assert (theirs["type"], theirs["seq"], theirs["status"], theirs["dt"]) == ("command", k, mine.status.value, DT)
        np.testing.assert_array_equal(theirs["v"], mine.v)
        assert [r["kind"] for r in theirs["assumptions"]] == [r.kind.value for r in mine.assumptions]
        q = pin.integrate(controller.scene.robot.model, q, DT * mine.v)
    assert np.abs(q - controller.scene.robot.home).max() > 0.01


def test_a_law_of_ones_own_is_served(serve, tmp_path):
    (tmp_path / "laws.py").write_text("def third(problem):\n    return problem.v_tracking / 3\n")
    scenario, law = scenario_with_law("panda_line", (), f"{tmp_path / 'laws.py'}:third")
    (ours, q), (theirs, _) = Controller.from_scenario(scenario), Controller.from_scenario(scenario)
    ours.solver, theirs.solver = law, "tracking"
    ask, frame = serve(served=scenario, law=law)[1](zmq.REQ).ask, scenario.tasks[0].frame
    ask("reset")
    target = ours.tick(q).kinematics.position[0] + [0.0, 0.0, 0.002]
    ours.reset()
    given = {frame: Sample.at(target)}
    answer = ask("step", q=q.tolist(), t=0.0, targets={frame: {"position": target.tolist()}})
    np.testing.assert_allclose(answer["v"], ours.step(q, 0.0, given).v, atol=1e-12)
    np.testing.assert_allclose(answer["v"], theirs.step(q, 0.0, given).v / 3, atol=1e-9)


def test_hello_says_what_a_client_has_to_know(serve):
    service, client = serve()
    hello = client().ask("hello", seq=1)
    assert hello["robot"] == "panda" and len(hello["q0"]) == len(hello["velocities"]) == 7
    assert hello["targets"] == [TOOL, "posture"] and {"ball", "camera"} <= set(hello["obstacles"])
    assert hello["commands"] == service.commands_endpoint and (hello["dt"], hello["heartbeat"]) == (DT, HEARTBEAT)
    assert service.endpoint.startswith("tcp://127.0.0.1:")


GOOD = {"version": 1, "type": "step", "seq": 7, "q": [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]}
WRONG = [
    (b"", "MALFORMED", "msgpack"),
    (b"\xc1", "MALFORMED", "msgpack"),
    (b"\x93\x01", "MALFORMED", "msgpack"),
    (b"\x91" * 3000, "MALFORMED", "msgpack"),
    (msgpack.packb([1, 2]), "MALFORMED", "not a map"),
    (msgpack.packb({1: 2}), "MALFORMED", "msgpack"),
    (b"\x00" * (MAX_MESSAGE + 1), "OVERSIZED", "bytes"),
    ({"version": 2}, "VERSION", "version 2"),
    ({"version": None}, "VERSION", "None"),
    ({"type": "stepp"}, "MALFORMED", "did you mean 'step'"),
    ({"type": ["step"]}, "MALFORMED", "type"),
    ({"q": [0.0] * 6}, "REFUSED", "q: shape"),
    ({"q": [0.0] * 6 + [float("nan")]}, "MALFORMED", "q.6"),
    ({"q": [0.0] * 6 + [float("inf")]}, "MALFORMED", "q.6"),
    ({"q": [0.0] * 6 + ["0.1"]}, "MALFORMED", "q.6"),
    ({"q": [0.0] * 6 + [True]}, "MALFORMED", "q.6"),
    ({"q": "0 0 0 0 0 0 0"}, "MALFORMED", "q"),
    ({"q": b"\x00" * 56}, "MALFORMED", "q"),
    ({"q": [[0.0]] * 7}, "MALFORMED", "q.0"),
    ({"q": [0.0] * 2000}, "MALFORMED", "q"),
    ({"q": None}, "MALFORMED", "q"),
    ({"speed": 1.0}, "MALFORMED", "speed"),
    ({"t": "now"}, "MALFORMED", "t"),
    ({"t": 2**63}, "MALFORMED", "t"),
    ({"v": [0.0]}, "REFUSED", "v: shape"),
    ({"seq": -1}, "MALFORMED", "seq"),
    ({"deadline": 0.0}, "LATE", "deadline"),
    ({"targets": {"hand": {"position": [0, 0, 0]}}}, "REFUSED", "hand"),
    ({"targets": {TOOL: {"position": [0.0, 0.0]}}}, "MALFORMED", f"targets.{TOOL}.position"),
    ({"targets": {TOOL: {}}}, "MALFORMED", f"targets.{TOOL}"),
    ({"targets": {TOOL: {"quaternion": [0.0, 0.0, 0.0, 2.0], "position": [0, 0, 0]}}}, "MALFORMED", "length 2"),
    ({"targets": [1]}, "MALFORMED", "targets"),
    ({"obstacles": {"bal": {"position": [0, 0, 0]}}}, "REFUSED", "did you mean 'ball'"),
    ({"obstacles": {"ball": {"position": [0, 0, float("nan")]}}}, "MALFORMED", "obstacles.ball.position"),
    ({"obstacles": {"ball": {"points": 0}}}, "MALFORMED", "no frame 0"),
    ({"obstacles": {"camera": {"points": 9}}}, "MALFORMED", "obstacles.camera.points"),
    ({"type": "filter"}, "MALFORMED", "v_desired"),
    ({"type": "attach", "q": None, "name": "cup"}, "MALFORMED", "frame"),
]  # fmt: skip


def test_wrong_messages_are_refused_by_name_and_change_nothing(serve, scenario):
    """After each of them the next command is that of a controller that never got it."""
    controller, q = Controller.from_scenario(scenario)
    ask, k = serve()[1](), 0

    def step():
        nonlocal q, k
        theirs = ask.ask("step", q=q.tolist(), t=k * DT, targets={TOOL: {"position": [0.4, 0.2, 0.5]}})
        mine = controller.step(q, k * DT, {TOOL: [0.4, 0.2, 0.5]})
        np.testing.assert_array_equal(theirs["v"], mine.v)
        q, k = pin.integrate(controller.scene.robot.model, q, DT * mine.v), k + 1

    step()
    for wrong, fault, words in WRONG:
        answer = ask.raw(wrong if isinstance(wrong, bytes) else msgpack.packb({**GOOD, **wrong}))
        assert (answer["type"], answer["error"]) == ("error", fault), (wrong, answer)
        assert words in answer["text"] and answer["text"].isprintable(), (wrong, answer)
        if isinstance(wrong, dict):
            assert answer["seq"] == (7 if "seq" not in wrong else None)
        step()
    good = msgpack.packb({**GOOD, "obstacles": {"camera": {"points": 0}}})
    assert ask.raw(good, b"\x00" * 13)["text"].endswith("32-bit numbers")
    assert ask.raw(good, b"\x00" * (MAX_FRAME + 1))["error"] == "OVERSIZED"
    assert ask.raw(good, *[b""] * 5)["error"] == "OVERSIZED"
    step()
    counts = ask.ask("status")["counts"]
    cut_off = msgpack.packb(GOOD)[:-9]
    assert (ask.raw(cut_off)["error"], ask.raw(cut_off)["seq"]) == ("MALFORMED", 7)
    no_seq = {name: value for name, value in GOOD.items() if name != "seq"}
    assert ask.raw(msgpack.packb({**no_seq, "speed": 1.0}))["seq"] == 0  # as of all that leave it out
    assert counts["step"] >= len(WRONG) and counts["OVERSIZED"] == 3 and counts["VERSION"] == 2


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=20)
    | st.binary(max_size=60) | st.sampled_from([float("nan"), float("inf"), 1e300, "step", TOOL]),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=12), inner, max_size=5),
    max_leaves=12,
)  # fmt: skip
WHOLE = {
    **GOOD, "t": 0.0, "v": [0.0] * 7, "targets": {TOOL: {"position": [0.4, 0.1, 0.5], "linear": [0.0, 0.0, 0.1]}},
    "obstacles": {"ball": {"position": [0.6, 0.0, 0.5], "quaternion": [0.0, 0.0, 0.0, 1.0], "t": 0.0}},
}  # fmt: skip


def places(value, path=()):
    """Paths of all entries of nested maps and lists."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from places(inner, (*path, key))


@st.composite
def messages(draw):
    """Bytes, objects, or a step with one or two entries exchanged; sometimes cut off, or longer than they should be."""
    kind = draw(st.integers(0, 3))
    if kind == 0:
        return draw(st.binary(max_size=300))
    if kind == 1:
        return msgpack.packb(draw(JUNK))
    message = copy.deepcopy(WHOLE)
    for _ in range(draw(st.integers(1, 2))):
        *path, last = draw(st.sampled_from(list(places(message)) or [("seq",)]))
        inner = message
        for key in path:
            inner = inner[key]
        inner[last] = draw(JUNK)
    packed = msgpack.packb(message)
    return packed[: draw(st.integers(0, len(packed)))] + draw(st.binary(max_size=8)) if kind == 3 else packed


def test_any_message_is_answered_and_the_loop_goes_on(serve):
    """Random messages: each has an answer, errors name themselves, and what comes next is a velocity."""
    client = serve()[1]()

    @settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
    @given(messages())
    def check(message):
        answer = client.raw(message)
        assert answer["type"] in ("error", "command", "hello", "status", "done")
        if answer["type"] == "error":
            assert answer["error"] in Fault.__members__ and answer["text"] and len(answer["text"]) <= 500
        elif answer["type"] == "command":
            assert np.isfinite(answer["v"]).all()
        assert client.ask("reset")["type"] == "done"
        command = client.ask("step", q=GOOD["q"])
        assert command["type"] == "command" and np.isfinite(command["v"]).all()

    check()


def test_lost_heartbeat_is_a_stop_within_the_limits(serve, scenario):
    """Velocities of one direction that end at zero; steps are refused until a reset."""
    controller, q = Controller.from_scenario(scenario)
    limits, model = controller.scene.robot.bounds().acceleration, controller.scene.robot.model
    service, client = serve(heartbeat=0.05)
    robot, commands_in = client(), listener(service, client)
    while not commands_in.socket.poll(20):  # until the subscription is known, steps from rest begin anew
        robot.ask("reset", v=[0.0] * 7)
        robot.ask("step", q=q.tolist())
    robot.ask("reset", v=[0.0] * 7)
    last = None
    for _ in range(20):
        last = robot.ask("step", q=q.tolist(), targets={TOOL: {"position": [0.5, 0.4, 0.5]}})
        if last["type"] == "error":  # the machine was too slow for this heartbeat
            robot.ask("reset", v=[0.0] * 7)
            continue
        q = pin.integrate(model, q, DT * np.array(last["v"]))
    command = msgpack.unpackb(commands_in.socket.recv())
    while not (command["reasons"] and command["reasons"][0]["kind"] == "HEARTBEAT_LOST"):
        v, command = np.array(command["v"]), msgpack.unpackb(commands_in.socket.recv())
    speeds = [np.abs(v).max()]
    while np.abs(command["v"]).max() > 0.0:
        assert command["status"] == "STOPPED" and command["seq"] is None
        now = np.array(command["v"])
        assert (np.abs(now - v) <= limits * DT + 1e-6).all()
        speeds.append(np.abs(now).max())
        v, command = now, msgpack.unpackb(commands_in.socket.recv())
    assert (np.diff(speeds) < 0.0).all() and len(speeds) < 100
    for _ in range(3):
        assert not np.abs(msgpack.unpackb(commands_in.socket.recv())["v"]).any()
    refused = robot.ask("step", q=q.tolist())
    assert refused["error"] == "HALTED" and "reset" in refused["text"]
    assert robot.ask("reset")["type"] == "done"
    assert robot.ask("step", q=q.tolist())["type"] == "command"
    status = robot.ask("status")
    assert status["halts"] >= 1 and status["counts"]["HALTED"] >= 1  # halts are no refusals


def test_one_client_is_in_control(serve):
    client = serve()[1]
    first, second = client(), client()
    assert first.ask("step", q=GOOD["q"])["type"] == "command"
    for kind, fields in (("step", {"q": GOOD["q"]}), ("reset", {}), ("remove_obstacle", {"name": "ball"})):
        assert second.ask(kind, **fields)["error"] == "BUSY"
    assert second.ask("hello")["state"] == "RUNNING"
    assert first.ask("step", q=GOOD["q"])["type"] == "command"


def test_later_steps_supersede_those_that_wait(serve):
    """Sent at once, while the server is busy with a slow one: each is answered, in order, and the last is a command."""
    ask = serve()[1]()
    cloud = np.random.default_rng(0).uniform(0.4, 1.0, (30_000, 3)).astype("<f4").tobytes()
    slow = {**GOOD, "seq": 0, "obstacles": {"camera": {"points": 0}}}
    ask.socket.send_multipart([msgpack.packb(slow), cloud])
    time.sleep(0.002)
    for k in range(1, 20):
        ask.socket.send(msgpack.packb({**GOOD, "seq": k}))
    answers = [msgpack.unpackb(ask.socket.recv()) for _ in range(20)]
    assert [answer["seq"] for answer in answers] == list(range(20))
    assert answers[-1]["type"] == "command"
    assert {answer.get("error", "SUPERSEDED") for answer in answers} == {"SUPERSEDED"}


def test_obstacles_come_and_go_and_are_held(serve):
    ask = serve()[1]().ask
    crate = {"name": "crate", "shape": {"type": "box", "size": [0.2, 0.2, 0.2]}, "position": [0.8, 0.3, 0.2]}
    assert ask("add_obstacle", **crate)["type"] == "done"
    assert "crate" in ask("hello")["obstacles"]
    assert ask("add_obstacle", **crate)["error"] == "REFUSED"
    assert ask("add_obstacle", **{**crate, "shape": {"type": "box"}})["error"] == "MALFORMED"
    assert ask("remove_obstacle", name="crate")["type"] == "done"
    assert ask("remove_obstacle", name="crate")["error"] == "REFUSED"
    assert ask("step", q=GOOD["q"], obstacles={"cup": {"position": [0.31, 0.0, 0.36]}})["type"] == "command"
    assert ask("attach", name="cup", frame=TOOL)["type"] == "done"
    assert ask("step", q=GOOD["q"], obstacles={"cup": {"position": [0, 0, 0]}})["assumptions"][0]["kind"] == "IGNORED"
    assert ask("release", name="cup")["type"] == "done"
    assert ask("attach", name="cup", frame="panda_hnd")["error"] == "REFUSED"


def test_ports_and_heartbeats_that_cannot_be_had(serve, scenario):
    service, _ = serve()
    with pytest.raises(ConfigError, match="--port"):
        Service(scenario, port=int(service.endpoint.rpartition(":")[2]))
    with pytest.raises(ConfigError, match="heartbeat"):
        Service(scenario, heartbeat=DT, port=0)


def walk(client, model, q, steps, **fields):
    """Follow commands; `fields` in the first step alone. Returns the last configuration and command."""
    for k in range(steps):
        command = client.ask("step", q=q.tolist(), **(fields if k == 0 else {}))
        assert command["type"] == "command", command
        q = pin.integrate(model, q, DT * np.array(command["v"]))
    return q, command


@pytest.fixture(scope="module")
def moving(scenario, tmp_path_factory):
    """The scenario, with a tool that would go on a line, and a ball that would come."""
    line = {"type": "line", "displacement": [0.0, 0.4, 0.0], "speed": 0.2}
    come = {"type": "line", "start": [0.9, 0.0, 0.5], "end": [0.3, 0.0, 0.5], "speed": 0.3, "rpy": [0.1, 0.2, 0.3]}
    first, *others = SCENARIO["obstacles"]
    path = tmp_path_factory.mktemp("service") / "moving.yaml"
    tasks = [{"frame": TOOL, "type": "pose", "motion": line}, SCENARIO["tasks"][1]]
    path.write_text(yaml.safe_dump({**SCENARIO, "tasks": tasks, "obstacles": [{**first, "motion": come}, *others]}))
    return load_scenario(str(path))


def test_what_is_not_sent_is_held_and_what_was_never_sent_stands(serve, moving):
    """Neither tool nor ball follow the scenario; a target that was sent once, with a velocity, is reached and kept."""
    robot = Controller.from_scenario(moving)[0].scene.robot
    client, q0 = serve(served=moving)[1](), robot.home
    elsewhere = q0 + 0.1 * np.arange(7) / 7.0  # not where the scenario begins
    q, command = walk(client, robot.model, elsewhere, 150)
    np.testing.assert_allclose(q, elsewhere, atol=1e-4)
    assert command["status"] == "SOLVED" and not command["stalled"]  # the ball would be in the arm by now

    def tool(q):
        data = robot.model.createData()
        pin.framesForwardKinematics(robot.model, data, q)
        return data.oMf[robot.frame_id(TOOL, "test")].translation.copy()

    goal = tool(q) + np.array([0.0, 0.1, 0.05])
    sent = {TOOL: {"position": goal.tolist(), "linear": [0.0, 0.2, 0.0]}}
    q, command = walk(client, robot.model, q, 400, targets=sent)
    np.testing.assert_allclose(tool(q), goal, atol=1e-2)  # the posture pulls a little
    assert np.abs(command["v"]).max() < 2e-2
    assert client.ask("step", q=[60.0] * 7)["status"] == "STOPPED"  # degrees: no place to hold
    assert client.ask("reset")["type"] == "done"  # forgotten: it stays where it is
    after, _ = walk(client, robot.model, q, 100)
    np.testing.assert_allclose(tool(after), tool(q), atol=1e-3)


def test_scenarios_motions_are_followed_if_asked_for(serve, moving):
    controller, q = Controller.from_scenario(moving)
    client = serve(served=moving, motions=True)[1]()
    client.ask("reset")
    for k in range(20):
        mine, theirs = controller.step(q, k * DT), client.ask("step", q=q.tolist(), t=k * DT)
        np.testing.assert_array_equal(theirs["v"], mine.v)
        q = pin.integrate(controller.scene.robot.model, q, DT * mine.v)
    assert np.abs(mine.v).max() > 0.05


def test_obstacles_that_are_left_out_again_stop_the_robot(serve, moving):
    """They stay where they were sent, also through a reset, and are stale from some time on, unless they rest."""
    client, q = serve(served=moving)[1](), GOOD["q"]
    client.ask("step", q=q, t=0.0, obstacles={"ball": {"position": [0.8, 0.0, 0.5]}})
    assert client.ask("step", q=q, t=0.3)["reasons"] == []
    assert client.ask("reset")["type"] == "done"
    client.ask("step", q=q, t=5.0)
    stopped = client.ask("step", q=q, t=5.7)
    assert stopped["status"] == "STOPPED" and stopped["reasons"][0]["subject"] == ["ball"]
    client.ask("step", q=q, t=5.71, obstacles={"ball": {"position": [0.8, 0.0, 0.5], "at_rest": True}})
    for t in (8.0, 16.0):
        assert client.ask("step", q=q, t=t)["status"] == "SOLVED"
