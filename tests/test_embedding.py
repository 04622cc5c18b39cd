"""The contract of docs/embedding.md: threads, clones, the same bits, joints by name, periods, watchdog."""

import gc
import subprocess
import sys
import threading

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import Ruler

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Obstacle,
    Pose,
    Robot,
    Sample,
    Solver,
    UnknownName,
    build_scene,
    build_tasks,
)
from qpavoid.adapters.handover import Handover
from qpavoid.adapters.timing import Rate, Watchdog
from qpavoid.config import Box, Line, Planning, PostureTask, Sphere, Task
from qpavoid.solvers import make_solver

TOOL, DT = "panda_hand_tcp", 0.01


def make_controller(panda, solver="qp", **fields):
    ball = Obstacle.at("ball", Sphere(radius=0.06), [0.5, 0.0, 0.45], graspable=True)
    tasks = build_tasks([Task(frame=TOOL), PostureTask(weight=1e-3)], panda, panda.home)
    avoidance = Avoidance(d1=0.02, d2=0.12)
    return Controller(build_scene(panda, [ball], spare_obstacles=3), tasks, solver, DT, avoidance=avoidance, **fields)


def drive(controller, steps=200, phase=0.0):
    """Commands (N, 7) of a loop around a ball that moves."""
    q, out = controller.scene.robot.home, []
    for k in range(steps):
        t = k * DT
        target = [0.45 + 0.1 * np.sin(t + phase), 0.2 * np.sin(2.0 * t), 0.45]
        ball = {"ball": Pose.at([0.5, 0.1 * np.cos(t), 0.45])}
        out.append(controller.step(q, t, {TOOL: target}, ball).v)
        q = q + DT * out[-1]
    return np.array(out)


def test_steps_leave_nothing_to_the_garbage_collector(panda):
    """With what a program has imported frozen, as the page advises, its walks find nothing and are short."""
    controller = make_controller(panda)
    drive(controller, 20)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        drive(controller, 100)
        assert gc.collect() == 0
    finally:
        gc.enable()
        gc.unfreeze()


# --- the same answer ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["qp", "qp:daqp", "hqp"])
def test_the_same_inputs_give_the_same_commands(panda, solver):
    """Bit for bit: of two controllers, of one after `reset`, and of two whose steps alternate with another one's."""
    one = make_controller(panda, solver)
    first = drive(one)
    one.reset()
    assert drive(one).tobytes() == first.tobytes()
    assert drive(make_controller(panda, solver)).tobytes() == first.tobytes()
    assert np.abs(first).max() > 0.1


PROGRAM = """
import hashlib, sys
sys.path[:0] = sys.argv[1:]
from qpavoid import Robot
from test_embedding import drive, make_controller
print(hashlib.sha256(drive(make_controller(Robot.load("panda"))).tobytes()).hexdigest())
"""


def test_another_process_gives_the_same_commands():
    import hashlib

    arguments = [path for path in sys.path if path]
    done = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == hashlib.sha256(drive(make_controller(Robot.load("panda"))).tobytes()).hexdigest()


# --- clones ---------------------------------------------------------------------------------------------------------


def test_a_clone_does_the_same(panda):
    controller = make_controller(panda)
    drive(controller, 50)
    controller.reset()
    twin = controller.clone()
    assert drive(twin).tobytes() == drive(controller).tobytes()
    assert twin.scene is not controller.scene and twin.tasks == controller.tasks


def test_a_clone_has_what_was_added_attached_and_allowed(panda):
    """And changes of one do not reach the other; where the slot before is empty again, too."""
    controller = make_controller(panda)
    for name, x in (("gone", 0.8), ("shelf", 0.6)):
        controller.add_obstacle(Obstacle.at(name, Box(size=(0.2, 0.4, 0.02)), [x, 0.0, 0.2]))
    controller.remove_obstacle("gone")
    data, q = panda.model.createData(), panda.home + 0.1
    pin.framesForwardKinematics(panda.model, data, q)
    grasp = data.oMf[panda.frame_id(TOOL, "test")].translation - np.array([0.0, 0.0, 0.1])
    controller.step(q, 0.0, obstacles={"ball": grasp})
    controller.attach("ball", TOOL, q)
    controller.allow_contact("ball", ["shelf"])
    twin = controller.clone()
    assert twin.scene.obstacle_names == controller.scene.obstacle_names and twin.attached == controller.attached
    for q in (panda.home, panda.home + 0.2):
        ours, others = controller.obstacle_pose("ball", q), twin.obstacle_pose("ball", q)
        np.testing.assert_allclose(ours.position, others.position, atol=1e-12)
    controller.reset()
    for _ in range(100):
        v = controller.step(q, targets={TOOL: [0.6, 0.0, 0.25]}).v
        np.testing.assert_allclose(twin.step(q, targets={TOOL: [0.6, 0.0, 0.25]}).v, v, atol=1e-9)
        q = q + DT * v
    twin.release("ball")
    twin.remove_obstacle("shelf")
    assert "shelf" in controller.scene.obstacle_names and "ball" in controller.attached


def test_a_clone_plans_like_its_original(panda):
    """Its forecasts know what was added: both begin the same plan at the same time, bit for bit."""
    tasks = [Task(frame=TOOL, motion=Line(displacement=(0.0, 0.3, 0.0), speed=0.3))]
    scene = build_scene(panda, spare_obstacles=2)
    avoidance = Avoidance(d1=0.02, d2=0.12)
    controller = Controller(
        scene, build_tasks(tasks, panda, panda.home), dt=DT, avoidance=avoidance, planning=Planning(settle=1.0)
    )
    controller.add_obstacle(Obstacle.at("ball", Sphere(radius=0.05), [0.35, 0.2, 0.45]))
    runs = []
    for one in (controller.clone(), controller):
        q, out = panda.home, []
        for _ in range(100):
            solution = one.step(q)
            out.append((solution.v.tobytes(), solution.plan))
            q = q + DT * solution.v
        runs.append(out)
    assert runs[0] == runs[1]


def test_a_clone_has_a_law_of_its_own(panda):
    class Counter(Solver):
        bounded = True
        calls = 0

        def solve(self, problem):
            self.calls += 1
            return make_solver("qp").solve(problem)

    controller = make_controller(panda, Counter())
    twin = controller.clone()
    twin.step(panda.home)
    assert isinstance(twin.solver, Counter) and (controller.solver.calls, twin.solver.calls) == (0, 1)
    eq10 = make_controller(panda, "eq10").clone()
    assert eq10.solver.label == "eq10"


def test_a_clone_has_the_budget_of_its_original(panda):
    """None at all: both leave out work, in the same steps."""

    def spent(controller):
        q, kinds = panda.home, []
        for k in range(60):
            ball = {"ball": Sample.at([0.7 - 0.008 * k, 0.0, 0.5], linear=[-0.8, 0.0, 0.0])}
            solution = controller.step(q, targets={TOOL: [0.5, 0.0, 0.45]}, obstacles=ball)
            kinds.append("BUDGET_SPENT" in {reason.kind.name for reason in solution.reasons})
            q = q + DT * solution.v
        return kinds

    controller = make_controller(panda, budget=1e-9)
    twin = controller.clone()
    assert spent(twin) == spent(controller) and any(spent(controller.clone()))


# --- threads ------------------------------------------------------------------------------------------------------


def in_threads(*functions):
    results, errors = [None] * len(functions), []

    def call(i, function):
        try:
            results[i] = function()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=call, args=item) for item in enumerate(functions)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return results


def test_controllers_in_threads_of_their_own_do_not_disturb_each_other(panda):
    """Switched a thousand times a second, clones of one controller give what they give alone."""
    controller, phases = make_controller(panda), (0.0, 0.7, 1.4)
    twins = [controller.clone() for _ in phases]
    expected = [drive(controller.clone(), phase=phase) for phase in phases]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        got = in_threads(
            *[
                lambda twin=twin, phase=phase: drive(twin, phase=phase)
                for twin, phase in zip(twins, phases, strict=True)
            ]
        )
    finally:
        sys.setswitchinterval(interval)
    for ours, alone in zip(got, expected, strict=True):
        assert ours.tobytes() == alone.tobytes()


def test_a_controller_goes_from_one_thread_to_another(panda):
    controller = make_controller(panda)
    (first,) = in_threads(lambda: drive(controller))
    controller.reset()
    assert drive(controller).tobytes() == first.tobytes()


def test_two_threads_in_one_controller_are_refused(panda):
    """The second one gets an error at once, and the first one goes on."""

    class Slow(Solver):
        bounded = True

        def solve(self, problem):
            inside.set()
            assert leave.wait(60.0)
            return make_solver("qp").solve(problem)

    controller, inside, leave = make_controller(panda), threading.Event(), threading.Event()
    controller.solver = Slow()

    def intrude():
        assert inside.wait(60.0)
        try:
            with pytest.raises(RuntimeError, match=r"two threads at once; give each one of its own: `clone\(\)`"):
                controller.step(panda.home)
        finally:
            leave.set()

    first, _ = in_threads(lambda: controller.step(panda.home), intrude)
    assert first.status.value == "SOLVED"
    leave.set()
    assert controller.step(panda.home).status.value == "SOLVED"


def test_updates_are_handed_over(panda):
    """A camera's thread reports a ball, and another one adds a pole meanwhile: the loop keeps clear of both."""
    controller, seen, end = make_controller(panda), Handover(), threading.Event()
    pole = Obstacle.at("pole", Sphere(radius=0.05), [0.45, -0.25, 0.45])

    def camera():
        k = 0
        while not end.is_set():
            seen.put("ball", Pose.at([0.5, 0.05 * np.sin(0.1 * k), 0.45]))
            k += 1
            end.wait(1e-3)
        return k

    def supervisor():
        seen.ask(controller.add_obstacle, pole).result(timeout=60.0)
        with pytest.raises(ConfigError, match="there is an obstacle 'pole'"):
            seen.ask(controller.add_obstacle, pole).result(timeout=60.0)

    def loop():
        q, k, statuses = panda.home, 0, set()
        while k < 300 or not late.is_set():
            solution = controller.step(q, targets={TOOL: [0.5, 0.2 * np.sin(0.02 * k), 0.45]}, obstacles=seen.take())
            statuses.add(solution.status.value)
            q, k = q + DT * solution.v, k + 1
        end.set()
        return q, statuses

    late = threading.Event()

    def supervise():
        supervisor()
        late.set()

    _, _, (q, _) = in_threads(camera, supervise, loop)
    assert "pole" in controller.scene.obstacle_names
    ruler = Ruler(build_scene(panda, [pole]))
    assert ruler.distances(q).min() > 0.0


def test_the_newest_update_of_each_name_counts():
    seen = Handover()
    seen.put("a", 1)
    seen.put("b", 2)
    seen.put("a", 3)
    order = []
    answered, cancelled = seen.ask(order.append, 1), seen.ask(order.append, 2)
    cancelled.cancel()
    assert seen.take() == {"a": 3, "b": 2} and seen.take() == {}
    assert order == [1] and answered.result(timeout=0.0) is None
    seen.put("a", 4)
    assert seen.take() == {"a": 4}


# --- joints by name -----------------------------------------------------------------------------------------------


def test_joints_by_name(panda):
    """A dict goes in as q, over the home pose, and v comes out as one."""
    q = panda.configuration({"panda_joint4": -2.0})
    assert q[3] == -2.0 and np.array_equal(np.delete(q, 3), np.delete(panda.home, 3))
    v = dict(zip(panda.coordinate_names, make_controller(panda).step(q).v, strict=True))
    assert list(v) == panda.joint_names
    with pytest.raises(UnknownName, match=r"q: .*'panda_joint9'"):
        panda.configuration({"panda_joint9": 0.0})


# --- periods --------------------------------------------------------------------------------------------------------


class Time:
    """A clock that goes on where it is waited for, or where work takes time."""

    def __init__(self):
        self.now = 10.0

    def __call__(self):
        return self.now

    def work(self, duration):
        self.now += duration


def test_periods_are_on_a_grid():
    """Lateness does not add up; where periods are missed, the loop goes on with the next one of the grid."""
    clock = Time()
    rate, begins = Rate(0.01, clock, clock.work), []
    for work in (0.004, 0.009, 0.012, 0.004, 0.035, 0.002):
        clock.work(work)
        rate.wait()
        begins.append(round(rate.t, 6))
    assert begins == [0.01, 0.02, 0.032, 0.04, 0.075, 0.08]
    assert rate.missed == 2


def test_a_watchdog_expires_once():
    clock, calls = Time(), []
    dog = Watchdog(0.1, lambda: calls.append(clock.now), clock)
    for _ in range(5):
        clock.work(0.09)
        dog.feed()
        assert dog.check() == pytest.approx(0.1)
    clock.work(0.11)
    assert dog.check() < 0.0 and dog.expired and dog.check() < 0.0 and calls == [clock.now]


def test_a_watchdog_stops_a_loop_that_hangs():
    stop = threading.Event()
    with Watchdog(0.05, stop.set) as dog:
        assert stop.wait(60.0) and dog.expired
    fed = Watchdog(600.0, stop.clear)
    with fed:
        fed.feed()
    assert stop.is_set() and not fed.expired
