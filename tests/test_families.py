"""Families of scenarios: what is drawn, what makes a case, and whether its solution is one, by other means."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from qpavoid import ScenarioConfig
from qpavoid.config.shipped import shipped_names
from qpavoid.errors import ConfigError, UnknownName
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.families import Draw, Redraw, load_family, make_case
from qpavoid_bench.arena.families.clearance import MIN_ADVANCE, Clearance
from qpavoid_bench.arena.families.inverse_kinematics import FrameGoal, JointRanges, solve_inverse_kinematics
from qpavoid_bench.arena.families.parameters import Parameter
from qpavoid_bench.arena.families.planner import plan
from qpavoid_bench.arena.families.solvable import find_plan
from qpavoid_bench.arena.suite import load_suite
from qpavoid_bench.arena.world import build_world, surface_safety_distance

FAMILIES = shipped_names("family")
TELEOPERATION = {family.name for family in load_suite("teleoperation").families}
UNPLANNED = {"adversarial", "unreachable", "standing_humanoid", *TELEOPERATION}
TIMED = {"chasing", "crossing", "head_on", "noisy_sensor", "random_walk", "stated_noise", "torque_arm"}

_cases: dict[tuple[str, int], Case] = {}


def case(name, seed):
    if (name, seed) not in _cases:
        _cases[name, seed] = make_case(load_family(name), seed)
    return _cases[name, seed]


# --- what ships --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FAMILIES)
def test_case_starts_clear_with_proof_of_solution(name):
    family = load_family(name)
    for seed in (0, 1):
        made = case(name, seed)
        scenario = made.scenario
        assert (made.family, made.seed, made.reachable) == (name, seed, family.config.reachable)
        assert scenario.robot == family.templates[seed % len(family.templates)]["robot"]
        assert ("RRT-Connect" in made.solved_by) == (
            made.reachable and family.config.proved and not family.config.static
        )
        assert ("time" in made.solved_by) == (name in TIMED)
        assert 3.0 < scenario.duration < 25.0
        world = build_world(scenario)
        data = world.scene.geometry.createData()
        pin.updateGeometryPlacements(
            world.scene.robot.model, world.scene.robot.model.createData(), world.scene.geometry, data, world.q0
        )
        pin.computeDistances(world.scene.geometry, data)
        nearest, d1 = (
            min((r.min_distance for r in data.distanceResults), default=1.0),
            surface_safety_distance(scenario),
        )
        assert nearest > d1 if family.config.starts_clear else -0.01 < nearest < d1
        assert Case.from_json(made.to_json()).key == made.key


def test_cases_are_the_same_in_another_process():
    chosen = [("situation1", 5), ("sphere_field", 1), ("crossing", 2), ("unreachable", 0), ("noisy_sensor", 1)]
    code = (
        "import sys, json\nfrom qpavoid_bench.arena.families import load_family, make_case\n"
        "print(json.dumps([make_case(load_family(n), s).to_json() for n, s in json.loads(sys.argv[1])]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(chosen)], capture_output=True, text=True, check=True, timeout=300
    )
    assert json.loads(done.stdout) == [make_case(load_family(n), s).to_json() for n, s in chosen]
    assert len({case("sphere_field", s).key for s in (1, 5)}) == 2


@pytest.mark.parametrize("name", [name for name in FAMILIES if name not in UNPLANNED])
def test_plan_is_clear_in_mujoco(name, monkeypatch):
    """Mujoco finds the plan clear."""
    pytest.importorskip("mujoco")
    from qpavoid.run.mujoco import build
    from qpavoid_bench.arena.checker import DistanceMonitor

    plans = []
    monkeypatch.setattr(
        "qpavoid_bench.arena.families.solvable.plan", lambda *given: plans.append(plan(*given)) or plans[-1]
    )
    scenario = make_case(load_family(name), 0).scenario
    world, keep, found = build_world(scenario), surface_safety_distance(scenario), plans[-1]
    mujoco_model = build(world.scene, world.q0)
    watch, q = DistanceMonitor(mujoco_model, measured_below=keep), np.array(found.q[0])
    np.testing.assert_array_equal(q, world.q0)
    watch.measure(0.0)
    speed = world.scene.robot.bounds().velocity
    for to, begin, end in zip(found.q[1:], found.t, found.t[1:], strict=False):
        v = (to - q) / (end - begin)
        assert (np.abs(v) <= speed).all()
        q = watch.follow(q, v, begin, end - begin)
        np.testing.assert_allclose(q, to, atol=1e-9)
    assert found.t[-1] <= (scenario.duration - 1.0 if name in TIMED else scenario.duration)
    watch.follow(q, 0.0 * q, found.t[-1], scenario.duration - found.t[-1])
    assert watch.distance >= keep - 1e-4
    assert watch.instants > 50
    data = world.scene.robot.model.createData()
    pin.framesForwardKinematics(world.scene.robot.model, data, q)
    for task in world.tools:
        goal = task.motion.sample(scenario.duration).position
        assert np.linalg.norm(data.oMf[task.frame_id].translation - goal) < scenario.goal_tolerance


@pytest.mark.parametrize("seed", range(2))
def test_goals_out_of_reach_are_not_attained_by_search(seed):
    """Goals out of reach are attained by no search."""
    made = case("unreachable", seed)
    world, random = build_world(made.scenario), np.random.default_rng(0)
    robot, ranges = world.scene.robot, JointRanges.of(world.scene.robot)
    clearance = Clearance(world, made.scenario.duration, 0.0)
    (task,) = world.tools
    goal = task.motion.sample(made.scenario.duration).position
    for _ in range(20):
        begin = random.uniform(ranges.lower, ranges.upper)
        q = solve_inverse_kinematics(
            robot, [FrameGoal(task.frame_id, goal)], begin, ranges, made.scenario.goal_tolerance
        )
        assert q is None or clearance.at(q, 0.0) < 0.0
        assert q is None or "inside" in made.solved_by


def test_tools_and_obstacles_meet_where_the_family_says():
    world = build_world(case("crossing", 0).scenario)
    times = np.linspace(0.0, 12.0, 2000)
    tool = np.array([world.tools[0].motion.sample(t).position for t in times])
    for obstacle in world.scene.obstacles:  # constant speed there, smooth here: not at quite the same time
        there = np.array([obstacle.motion.sample(t).position for t in times[::10]])
        assert np.linalg.norm(tool[:, None] - there, axis=2).min() < 0.05 * 1.3 + 0.01
    for name in ("crossing_arms", "passing"):
        left, right = (task.motion for task in build_world(case(name, 0).scenario).tools)
        apart = np.array([left.sample(t).position - right.sample(t).position for t in times])
        assert apart[0, 1] > 0.0 > apart[-1, 1] and abs(apart[-1, 2]) > 0.01
    at_rest = np.linalg.norm(np.diff(apart, axis=0), axis=1) < 1e-12  # of passing: they meet, and pause
    gap = np.linalg.norm(apart[1:][at_rest], axis=1)
    assert ((gap >= 0.04 - 1e-9) & (gap <= 0.12 + 1e-9)).any()


# --- drawing -----------------------------------------------------------------------------------------------


def parameter(**fields):
    return TypeAdapter(Parameter).validate_python({"about": "something", **fields})


def test_whole_numbers_reach_both_ends_and_logarithms_are_even():
    rng = np.random.default_rng(0)
    assert {parameter(type="uniform", range=[2, 4], whole=True).draw(rng) for _ in range(100)} == {2, 3, 4}
    counts = [parameter(type="log_uniform", range=[2, 40], whole=True).draw(rng) for _ in range(2000)]
    assert {2, 40} <= set(counts) <= set(range(2, 41))
    below = np.mean(np.array(counts) < 9)  # P = log(9/2) / log(41/2)
    assert below == pytest.approx(np.log(4.5) / np.log(20.5), abs=0.04)
    directions = np.array([parameter(type="direction").draw(rng) for _ in range(2000)])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(directions.T @ directions / 2000, np.eye(3) / 3.0, atol=0.03)


def test_a_new_parameter_leaves_the_others_as_they_are():
    one = {"a": parameter(type="uniform", range=[0, 1])}
    more = {"b": parameter(type="direction"), **one}
    first, second = Draw(one, 3, 0, frozenset()), Draw(more, 3, 0, frozenset())
    second("b")
    assert [first("a") for _ in range(3)] == [second("a") for _ in range(3)]
    assert first("a") != Draw(one, 4, 0, frozenset())("a")
    kept = Draw(one, 3, 1, frozenset({"a"}))
    assert kept("a") == kept("a")


# --- distances and plans, by brute force -------------------------------------------------------------------

GANTRY = """<robot name="gantry">
  <link name="base"/><link name="bridge"/>
  <link name="ball"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <joint name="x" type="prismatic"><parent link="base"/><child link="bridge"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="y" type="prismatic"><parent link="bridge"/><child link="ball"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def gantry(tmp_path_factory):
    path = tmp_path_factory.mktemp("gantry") / "gantry.urdf"
    path.write_text(GANTRY)
    return path


def wall(name, low, high, motion=None):
    """A box in the plane x = 0 from y = low to high."""
    middle = [0.0, 0.5 * (low + high), 0.0]
    motion = {"type": "fixed", "position": middle} if motion is None else motion(middle)
    return {"name": name, "shape": {"type": "box", "size": [0.1, high - low, 1.0]}, "motion": motion}


def scenario_of(robot, obstacles, duration=8.0, **fields):
    """The ball has to go from one side of x = 0 to the other."""
    config = {
        "robot": str(robot), "obstacles": obstacles, "duration": duration, "q0": {"x": -0.5, "y": 0.0},
        "tasks": [{"frame": "ball", "motion": {"type": "line", "displacement": [1.0, 0.0, 0.0], "speed": 0.2}}],
        "avoidance": {"d1": 0.02, "d2": 0.1}, **fields,
    }  # fmt: skip
    return ScenarioConfig.model_validate(config).with_source(Path("handmade.yaml"))


def planned(scenario):
    world = build_world(scenario)
    clearance = Clearance(world, scenario.duration, surface_safety_distance(scenario))
    return find_plan(scenario, world, clearance, np.random.default_rng(0))


def test_plan_goes_through_opening(gantry):
    """A plan goes through the opening and no wall."""
    found = planned(scenario_of(gantry, [wall("low", -1.2, 0.4), wall("high", 0.6, 1.2)]))
    crossing = [
        a + (b - a) * a[0] / (a[0] - b[0]) for a, b in zip(found.q, found.q[1:], strict=False) if a[0] * b[0] < 0
    ]
    assert all(0.4 + 0.05 + 0.02 < y < 0.6 - 0.05 - 0.02 for _, y in crossing)
    assert len(crossing) == 1
    # 1 m ahead at 0.5 rad/s or m/s: no faster than speed limits allow
    assert found.t[-1] >= 2.0
    assert found.length < 2.0  # shortcuts: the shortest is 1.4


def test_plan_is_none_without_solution(gantry, monkeypatch):
    """No plan where there is none."""
    monkeypatch.setattr("qpavoid_bench.arena.families.planner.MAX_NODES", 1000)
    with pytest.raises(Redraw, match="no plan"):
        planned(scenario_of(gantry, [wall("all", -1.2, 1.2)]))
    with pytest.raises(Redraw, match="no plan"):  # 120 mm for a ball of 100 mm that keeps 20 mm on each side
        planned(scenario_of(gantry, [wall("low", -1.2, -0.06), wall("high", 0.06, 1.2)]))
    with pytest.raises(Redraw, match="clear"):
        ball = {"name": "b", "shape": {"type": "sphere", "radius": 0.1}}
        planned(scenario_of(gantry, [{**ball, "motion": {"type": "fixed", "position": [0.5, 0.0, 0.0]}}]))


def test_plan_in_space_time_waits_for_door(gantry):
    """A plan waits for a door."""

    def opens(middle):
        return {"type": "waypoints", "times": [3.0, 4.0], "positions": [middle, [0.0, middle[1] + 0.5, 0.0]]}

    walls = [wall("low", -1.2, -0.1), wall("door", -0.1, 1.2, opens)]
    found = planned(scenario_of(gantry, walls))
    times = np.linspace(0.0, 8.0, 4000)
    x = np.interp(times, found.t, found.q[:, 0])
    assert times[x > 0.0].min() > 3.0
    assert found.t[-1] == 7.0  # a second before the end
    rates = np.abs(np.diff(found.q, axis=0)) / np.diff(found.t)[:, None]
    assert rates.max() <= 0.5 + 1e-9
    with pytest.raises(Redraw):  # closed again before a ball at 0.5 m/s comes through
        planned(scenario_of(gantry, walls, duration=4.4))


@pytest.mark.parametrize("moves", [False, True])
def test_clearance_between_is_that_of_the_nearest_point(gantry, moves):
    """Straight motions are judged by their nearest point."""
    fixed = {"type": "fixed", "position": [0.0, 0.0, 0.0]}
    rolls = {"type": "line", "start": [0.0, -1.0, 0.0], "end": [0.0, 1.0, 0.0], "speed": 0.25}
    bead = {"name": "bead", "shape": {"type": "sphere", "radius": 0.005}, "motion": rolls if moves else fixed}
    world = build_world(scenario_of(gantry, [bead]))
    clearance, motion = Clearance(world, 8.0, 0.01), world.scene.obstacles[0].motion
    random, answers = np.random.default_rng(0), []
    for _ in range(400):
        ta, tb = sorted(random.uniform(0.0, 8.0, 2))
        a, b = random.uniform(-0.5, 0.5, (2, 2))
        # both go straight at constant speed: so does one as seen from the other
        first, last = (q - motion.sample(t).position[:2] for q, t in ((a, ta), (b, tb)))
        share = np.clip(first @ (first - last) / ((first - last) @ (first - last)), 0.0, 1.0)
        least = np.linalg.norm(first + share * (last - first)) - 0.055
        answers.append(clearance.is_clear_between(a, ta, b, tb))
        assert least >= 0.01 if answers[-1] else least < 0.01 + MIN_ADVANCE
    assert 50 < sum(answers) < 350


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_clearance_between_holds_at_every_sample(seed):
    """A motion that is passed is clear at every place."""
    random = np.random.default_rng(seed)
    made = case("sphere_field" if seed % 2 else "head_on", seed % 3)
    world, keep = build_world(made.scenario), surface_safety_distance(made.scenario)
    clearance = Clearance(world, made.scenario.duration, keep)
    a = world.q0 + random.uniform(-0.2, 0.2, len(world.q0))
    b = a + random.uniform(-0.5, 0.5, len(a))
    ta, tb = sorted(random.uniform(0.0, made.scenario.duration, 2))
    least = min(clearance.at(a + s * (b - a), ta + s * (tb - ta)) for s in np.linspace(0.0, 1.0, 200))
    if clearance.is_clear_between(a, ta, b, tb):
        assert least >= keep
    else:
        assert least < clearance.least + 0.005


@pytest.mark.parametrize("name", ["panda", "ur5", "gantry"])
def test_clearance_lever_arms_bound_travel(name, gantry):
    """No point moves farther than its levers allow."""
    made = ScenarioConfig.model_validate(
        {"robot": str(gantry) if name == "gantry" else name, "duration": 1.0,
         "tasks": [{"frame": {"panda": "panda_hand_tcp", "ur5": "tool0", "gantry": "ball"}[name]}]}
    )  # fmt: skip
    world = build_world(made)
    robot, random = world.scene.robot, np.random.default_rng(3)
    lever_arm, ranges = Clearance(world, 1.0, 0.02).lever_arm, JointRanges.of(robot)
    data, longest = robot.model.createData(), 0.0
    for _ in range(300):
        q = random.uniform(ranges.lower, ranges.upper)
        pin.computeJointJacobians(robot.model, data, q)
        placed = robot.bodies.createData()
        pin.updateGeometryPlacements(robot.model, data, robot.bodies, placed)
        for body, place in zip(robot.bodies.geometryObjects, placed.oMg, strict=True):
            along = random.uniform(-1.0, 1.0) * getattr(body.geometry, "halfLength", 0.0)
            point = place.act(np.array([0.0, 0.0, along]))
            J = pin.getJointJacobian(robot.model, data, body.parentJoint, pin.WORLD)
            speed = np.linalg.norm(J[:3] + np.cross(J[3:].T, point).T, axis=0)
            assert (speed <= lever_arm + 1e-9).all()
            longest = max(longest, float((speed / lever_arm).max()))
    assert longest > 0.5  # they are no bounds for their own sake


# --- a reader's own family ---------------------------------------------------------------------------------

TEMPLATE = """
title: A post
about: A tool goes past a post.
robots: [ur5]
parameters:
  y: {type: uniform, range: [-0.25, -0.1], about: "of the post [m]"}
  radius: {type: choice, of: [0.02, 0.03], about: "of the post [m]"}
  delay: {type: uniform, range: [0.01, 0.05], about: "of the sensor [s]"}
scenario:
  tasks:
    - {frame: tool0, motion: {type: line, displacement: [0, -0.5, 0], speed: 0.15}}
  obstacles:
    - name: post
      shape: {type: capsule, radius: $radius, length: 0.5}
      motion: {type: fixed, position: [0.6, $y, 0.25]}
  duration: 6
  dt: 0.02
sensor: {delay: $delay}
"""
GENERATED = """
title: Posts
about: Some posts.
robots: [{robot: ur5, avoidance: {d1: 0.03, d2: 0.1}}]
generator: posts.py:posts
parameters:
  count: {type: uniform, range: [1, 3], whole: true, about: "how many"}
  y: {type: uniform, range: [-0.3, -0.1], about: "of each [m]"}
scenario: {dt: 0.02}
"""
POSTS = """
def posts(draw, robot):
    shape = {"type": "capsule", "radius": 0.02, "length": 0.4}
    places = [[0.65, draw("y"), 0.2] for _ in range(draw("count"))]
    motion = {"type": "line", "displacement": [0, -0.5, 0], "speed": 0.2}
    return {
        "tasks": [{"frame": robot.end_effectors[0], "motion": motion}],
        "obstacles": [
            {"name": f"post{i}", "shape": shape, "motion": {"type": "fixed", "position": place}}
            for i, place in enumerate(places)
        ],
        "duration": 5.0,
    }
"""
UNLUCKY = """
from qpavoid_bench.arena.families import Redraw
def posts(draw, robot):
    raise Redraw('bad luck')
"""


@pytest.fixture
def family(tmp_path):
    """Writes a family, with some of its text replaced, and loads it."""

    def family(text, *changes, code=POSTS):
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "own.yaml").write_text(text)
        (tmp_path / "posts.py").write_text(code)
        return load_family(tmp_path / "own.yaml")

    return family


@pytest.mark.parametrize(
    ("text", "change", "error", "said"),
    [
        (TEMPLATE, ("$y", "$yy"), UnknownName, r"scenario.obstacles.0.motion.position.1: unknown .*; did you mean 'y'"),
        (TEMPLATE, ("$delay", "0.01"), ConfigError, r"parameters.delay: stands nowhere as \$delay"),
        (TEMPLATE, ("[-0.25, -0.1]", "[-0.1, -0.25]"), ConfigError, r"parameters.y: range: needs low < high"),
        (TEMPLATE, ("robots: [ur5]", "robots: [ur6]"), UnknownName, r"robots.0: unknown robot 'ur6'.*'ur5'"),
        (TEMPLATE, ("robots: [ur5]", "robots: [{robot: ur5, lock: [$l]}]"), UnknownName, r"lock.0: unknown .*\$l"),
        (TEMPLATE, ("robots: [ur5]", "robots: [{q0: {}}]"), ConfigError, r"robots.0: needs a field `robot`"),
        (TEMPLATE, ("  dt: 0.02", "  robot: ur5"), ConfigError, r"`robot` belongs into `robots`"),
        (GENERATED, ("posts.py:posts", "posts.py:post"), UnknownName, r"no 'post' in it; did you mean 'posts'"),
        (GENERATED, ("posts.py:posts", "pots.py:posts"), ConfigError, r"pots.py: cannot be read: No such file"),
        (GENERATED, ("posts.py:posts", "shelv"), UnknownName, r"unknown generator 'shelv'; did you mean 'shelf'"),
    ],
)  # fmt: skip
def test_family_file_errors_name_file_and_field(family, text, change, error, said):
    with pytest.raises(error, match=said) as raised:
        family(text, change)
    assert "own.yaml" in str(raised.value)


@pytest.mark.parametrize(
    ("text", "change", "code", "error", "said"),
    [
        (GENERATED, None, POSTS.replace('draw("y")', 'draw("yy")'), UnknownName, r"unknown parameter 'yy'"),
        (GENERATED, None, POSTS.replace('draw("y")', "-0.2"), ConfigError, r"never draws 'y'"),
        (GENERATED, None, POSTS.replace("robot.end", "robot.and"), ConfigError, r"AttributeError: .*and_effectors"),
        (GENERATED, ("{dt: 0.02}", "{duration: 3}"), POSTS, ConfigError, r"scenario.duration: the generator gives it"),
        (GENERATED, None, UNLUCKY, ConfigError, r"10 draws and no case, most often: bad luck"),
        (TEMPLATE, ("[0, -0.5, 0]", "[0, -5, 0]"), POSTS, ConfigError, r"most often: the goal is not attained"),
        (TEMPLATE, ("[0.6, $y, 0.25]", "[0, 0, 0.1], rpy: [0, 0, $y]"), POSTS, ConfigError, r"most often: .* too near"),
        (TEMPLATE, ("sensor:", "reachable: false\nsensor:"), POSTS, ConfigError, r"no goal is out of reach"),
        (TEMPLATE, ("dt: 0.02", "contacts: [{frame: tool0}]"), POSTS, ConfigError, r"contacts are checked on a plant"),
        (TEMPLATE, ("{frame: tool0, motion", "{frame: tool0, type: orientation, motion"), POSTS, ConfigError,
         r"none is that of a frame with a position"),
        (GENERATED, ("posts.py:posts", "passing"), POSTS, ConfigError, r"ur5 has 1 arms that move; two are needed"),
    ],
)  # fmt: skip
def test_family_without_case_names_cause(family, monkeypatch, text, change, code, error, said):
    """A family that makes no case says why."""
    monkeypatch.setattr("qpavoid_bench.arena.families.solvable.MAX_TRIES", 5)
    monkeypatch.setattr("qpavoid_bench.arena.families.make.MAX_DRAWS", 10)
    loaded = family(text, *([change] if change else []), code=code)
    with pytest.raises(error, match=said) as raised:
        make_case(loaded, 0)
    assert "own.yaml" in str(raised.value)


def test_the_file_counts_more_than_a_setup_and_a_robots_entry_more_than_the_file(family):
    stated = ("  dt: 0.02", "  dt: 0.02\n  avoidance: {d1: 0.05, d2: 0.2}")
    assert make_case(family(TEMPLATE, stated), 0).scenario.avoidance.d1 == 0.05
    entry = ("robots: [ur5]", "robots: [ur5, {robot: ur5, avoidance: {d1: 0.04, d2: 0.2}}]")
    loaded = family(TEMPLATE, stated, entry)
    assert [make_case(loaded, seed).scenario.avoidance.d1 for seed in range(2)] == [0.05, 0.04]
    assert make_case(family(TEMPLATE), 0).scenario.avoidance.d1 == 0.02


def test_a_case_is_the_same_wherever_its_file_lies(family, tmp_path):
    here = make_case(family(TEMPLATE), 0)
    there = tmp_path / "elsewhere" / "own.yaml"
    there.parent.mkdir()
    there.write_text(TEMPLATE)
    assert make_case(load_family(there), 0).key == here.key
