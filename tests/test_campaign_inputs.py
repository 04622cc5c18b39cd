"""Thousands of calls with arguments of every sort: each ends, in a documented way, with bounded work, and a refused one
leaves nothing behind."""

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import (
    Avoidance,
    ConfigError,
    Limits,
    NumericalError,
    Obstacle,
    Points,
    Pose,
    Sample,
    Solution,
    Status,
    build_scene,
    build_tasks,
)
from qpavoid.config import Backup, Box, HalfSpace, PointCloud, PostureTask, Sphere, Task
from qpavoid.control.distances import DistanceQuery
from qpavoid.controller import Controller

TOOL = "panda_hand_tcp"
MOST_LOOKS = 3000
"""Distances of the whole scene that a control step may look at: five steps back of 48 poses and 200 control periods
of a stop each for the look-ahead, and three backup trajectories for the next and for this step, of 40 decisions, twice.
"""
HUGE = [1e3, 2e3, 1e6, 2e6, 1e9, 1e16, 1e100, 1e155, 1e200, 1.7e308]
TINY = [0.0, -0.0, 5e-324, 1e-300, 1e-160, 1e-16, 1e-9]
MISTYPED = [None, "x", 1j, [], {}, object(), [[1.0]], np.zeros((2, 2)), np.array(["a"]), b"0", True,
            np.array([None] * 7), 10**400, [10**400], np.full(7, 1j), set(), float, (1, 2, 3),
            np.zeros(0), np.float32(1.0)]  # fmt: skip


class Caller:
    """Draws calls: mostly good ones of a loop that goes on, in which some arguments are replaced."""

    def __init__(self, seed, robot):
        self.rng, self.robot, self.t = np.random.default_rng(seed), robot, 0.0
        self.names = ["ball", "box", "camera", "ground", "late"]

    def chance(self, share):
        return self.rng.random() < share

    def pick(self, options):
        return options[self.rng.integers(len(options))]

    def number(self):
        sign = self.pick([-1.0, 1.0])
        return self.pick([np.nan, np.inf, -np.inf, sign * self.pick(HUGE), sign * self.pick(TINY), self.rng.normal()])

    def spoilt(self, array, share):
        """The array (n,), with one or all of its numbers replaced, or something else in its place."""
        if not self.chance(share):
            return array
        if self.chance(0.3):
            return self.pick(MISTYPED)
        array = np.array(array)
        if self.chance(0.2):
            array[...] = self.number()
        else:
            array.flat[self.rng.integers(array.size)] = self.number()
        return array

    def rotation(self):
        R = pin.exp3(self.rng.normal(size=3))
        wrong = [0.5 * R, -R, np.zeros((3, 3)), 1e200 * R, R @ np.diag([1, 1, -1])]
        return self.pick([R, R, np.eye(3), 1.0003 * R, *wrong])

    def stamp(self, share):
        return self.spoilt_time(self.pick([None, self.t, self.t - 0.02, self.t - 3.0]), share)

    def spoilt_time(self, t, share):
        if not self.chance(share):
            return t
        times = [self.t + 0.03, self.t + 7.0, self.t - 2.0, 1.7e9, 1.7e12, 1.7e15, 1.7e18, -1e6]
        return self.pick([*times, self.number(), self.pick(MISTYPED)])

    def sample(self, share):
        place = self.rng.uniform([-0.5, -0.6, 0.1], [0.9, 0.6, 1.2])
        R = np.eye(3) if not self.chance(share) else self.spoilt(self.rotation(), 0.2)
        twist = self.rng.normal(size=(2, 3)) * self.pick([0.0, 0.2, 2.0])
        at_rest = self.pick([False, False, False, True, *(["yes", None, 0.0] if self.chance(share) else [])])
        place = self.spoilt(place, share)
        if self.chance(0.4):
            return Pose(place, R, self.stamp(share), at_rest)
        linear, angular = (self.spoilt(part, share) for part in twist)
        return Sample(place, R, linear, angular, self.stamp(share), at_rest)

    def points(self, share):
        points = self.rng.uniform(-0.2, 1.0, (int(self.rng.integers(0, 20)), 3))
        points = self.spoilt(points, share) if points.size else points
        pose = self.sample(share) if self.chance(0.3) else None
        pose = pose if isinstance(pose, Sample) or self.chance(share) else None
        return Points(points, pose, self.stamp(share), self.chance(0.2))

    def obstacles(self, share):
        if self.chance(share * 0.3):
            return self.pick(MISTYPED)
        given = {}
        for name in self.names:
            if self.chance(0.6):
                given[name] = self.points(share) if name == "camera" else self.sample(share)
                if self.chance(share * 0.3):
                    given[name] = self.pick([*MISTYPED, self.points(share), (np.zeros(3), np.eye(3))])
        if self.chance(share * 0.2):
            given[self.pick(["typo", 3, None, ("a",)])] = self.sample(share)
        return given or None

    def targets(self, share):
        if self.chance(share * 0.3):
            return self.pick(MISTYPED)
        given = {}
        if self.chance(0.5):
            given[TOOL] = self.sample(share)
        if self.chance(0.3):
            given["posture"] = self.spoilt(self.robot.home + self.rng.normal(size=7), share)
        if self.chance(share * 0.2):
            given[self.pick(["typo", 3, None])] = self.sample(share)
        return given or None

    def call(self, q, v):
        """Name of a method, and its arguments."""
        share = self.pick([0.0, 0.0, 0.0, 0.05, 0.2])
        self.t += self.pick([0.01] * 8 + [0.0, 0.02, 0.3, 5.0, -1.0])
        kind = self.pick(["step"] * 12 + ["filter"] * 6 + ["attach", "release", "allow_contact", "reset", "solver"])
        t = self.spoilt_time(self.pick([None, self.t]), share)
        measured = self.spoilt(v, share) if self.chance(0.2) else None
        q = self.spoilt(q, share)
        names = [*self.names, "panda_hand_0", TOOL, "panda_joint3", "typo"] + (MISTYPED if self.chance(share) else [])
        if kind == "step":
            return "step", (q, t, self.targets(share), self.obstacles(share), measured)
        if kind == "filter":
            return "filter", (q, self.spoilt(self.rng.normal(size=7), share), t, self.obstacles(share), measured)
        if kind == "attach":
            return "attach", (self.pick(names), self.pick(names), self.pick([None, q]))
        if kind == "release":
            return "release", (self.pick(names), self.pick([None, q]))
        if kind == "allow_contact":
            others = self.pick([[self.pick(names), self.pick(names)], self.pick(names)])
            return "allow_contact", (self.pick(names), others, self.chance(0.5))
        if kind == "solver":
            return "solver", (self.pick(MISTYPED),)
        return "reset", (self.pick([None, self.spoilt(v, share)]),)


def make(panda, jerk):
    scene = build_scene(
        panda,
        [Obstacle.at("ball", Sphere(radius=0.05), [0.5, 0.0, 0.75]),
         Obstacle.at("box", Box(size=(0.05, 0.05, 0.1)), [0.35, 0.0, 0.45], graspable=True),
         Obstacle.at("camera", PointCloud(), [0, 0, 0]),
         Obstacle.at("ground", HalfSpace(), [0, 0, -0.2]),
         Obstacle.at("late", Sphere(radius=0.05), [0.0, 0.8, 0.5], external=True)],
    )  # fmt: skip
    tasks = build_tasks([Task(frame=TOOL), PostureTask(weight=0.01)], panda, panda.home)
    limits = Limits(jerk=jerk) if jerk else Limits()
    return Controller(scene, tasks, "qp", 0.01, Avoidance(d1=0.02, d2=0.15, backup=Backup(horizon=0.5)), limits)


def answer(controller, kind, arguments):
    """What a call answers; None where it is refused, with an error that is documented."""
    try:
        if kind == "solver":
            controller.solver = arguments[0]
            return ()
        found = getattr(controller, kind)(*arguments)
    except (NumericalError, ConfigError):
        return None
    if isinstance(found, Solution):
        return found.v, found.status, found.reasons, found.stalled, found.assumptions
    return () if found is None else (found.position, found.rotation)


def campaign(panda, seed, calls, monkeypatch, jerk=None):
    """Two controllers get the same calls, but for those that one of them refused; how many of which kind there were."""
    caller, one, twin = Caller(seed, panda), make(panda, jerk), make(panda, jerk)
    looks, compute = [0], DistanceQuery.compute

    def counted(self, *args):
        looks[0] += 1
        compute(self, *args)

    monkeypatch.setattr(DistanceQuery, "compute", counted)
    fastest, q, v = panda.bounds().velocity + 1e-9, panda.home.copy(), np.zeros(7)
    count = {"refused": 0, "STOPPED": 0, "SOLVED": 0, "RELAXED": 0, "looks": 0}
    for k in range(calls):
        kind, arguments = caller.call(q, v)
        looks[0] = 0
        found = answer(one, kind, arguments)
        count["looks"] = max(count["looks"], looks[0])
        assert looks[0] <= MOST_LOOKS, (k, kind, arguments)
        if found is None:
            count["refused"] += 1
            continue
        expected = answer(twin, kind, arguments)
        assert expected is not None, (k, kind, arguments)
        for a, b in zip(found, expected, strict=True):
            if isinstance(a, np.ndarray):
                assert a.tobytes() == b.tobytes(), (k, kind, arguments)
            else:
                assert a == b or "nan" in str(a), (k, kind, arguments)
        if kind in ("step", "filter"):
            v = found[0]
            assert np.isfinite(v).all() and (np.abs(v) <= fastest).all(), (k, kind, arguments)
            count[found[1].value] += 1
            q = np.clip(q + 0.01 * v, panda.bounds().lower, panda.bounds().upper)
            if caller.chance(0.02):
                q = panda.home + caller.rng.uniform(-0.3, 0.3, 7)
    monkeypatch.undo()
    assert one.step(panda.home, None).status in Status
    return count


@pytest.mark.parametrize(("seed", "jerk", "calls"), [(0, None, 300), (1, 500.0, 50)])
def test_calls_of_all_kinds_end_in_a_documented_way(panda, monkeypatch, seed, jerk, calls):
    count = campaign(panda, seed, calls, monkeypatch, jerk)
    assert min(count["refused"], count["STOPPED"], count["RELAXED"]) > calls / 50


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 110))
def test_campaign_of_calls_of_all_kinds(panda, monkeypatch, seed):
    """20,000 calls in all; a fifth of them of a robot with jerk limits."""
    count = campaign(panda, seed, 2000, monkeypatch, None if seed % 5 else 500.0)
    print(seed, count)
    assert min(count["refused"], count["STOPPED"], count["SOLVED"], count["RELAXED"]) > 20
