"""Obstacles that are added and removed at run time are those of a scene that had them from the start."""

import gc

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import accelerations, cartesian, make_controller

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Obstacle,
    Points,
    Pose,
    Sample,
    Status,
    UnknownName,
    build_scene,
    build_tasks,
    load_scenario,
)
from qpavoid.config import Box, Capsule, Cone, Cylinder, Ellipsoid, HalfSpace, Line, Mesh, PointCloud, Sphere, Task
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.trajectory import build_motion, still
from qpavoid.reason import ReasonKind
from qpavoid.run.recorder import Recorder
from qpavoid.viz.figures import plot_compare, plot_run

TCP, DT = "panda_hand_tcp", 0.01
CORNERS = [(x, y, z) for x in (-0.05, 0.05) for y in (-0.06, 0.06) for z in (-0.04, 0.04)]
SHAPES = {
    "sphere": Sphere(radius=0.07),
    "capsule": Capsule(radius=0.04, length=0.1),
    "box": Box(size=(0.1, 0.14, 0.08)),
    "cylinder": Cylinder(radius=0.05, length=0.12),
    "cone": Cone(radius=0.07, length=0.14),
    "ellipsoid": Ellipsoid(radii=(0.05, 0.08, 0.06)),
}


def controller_of(panda, obstacles=(), spare=0, **fields):
    tasks = build_tasks([Task(frame=TCP, gain=3.0)], panda, panda.home)
    fields.setdefault("avoidance", Avoidance(d1=0.02, d2=0.12))
    return Controller(build_scene(panda, obstacles, spare_obstacles=spare), tasks, "qp", DT, **fields)


def tool(panda, q):
    data = panda.model.createData()
    pin.framesForwardKinematics(panda.model, data, q)
    return data.oMf[panda.model.getFrameId(TCP)]


def loop(panda, controller, steps=120, updates=None, before=None):
    """Velocities (steps, nv), reasons and last tick of the tool going 0.25 m to the side."""
    start, q, vs, said = tool(panda, panda.home).translation, panda.home.copy(), [], []
    for k in range(steps):
        if before is not None:
            before(k, q)
        target = Sample.at(start + np.array([0.0, min(0.005 * k, 0.25), 0.0]))
        given = updates(k) if updates else None
        tick = controller.tick(q, k * DT, {TCP: target}, given)
        vs.append(tick.solution.v)
        said.append([str(reason) for reason in (*tick.solution.reasons, *tick.solution.assumptions)])
        q = pin.integrate(panda.model, q, DT * tick.solution.v)
    return np.array(vs), said, tick


def beside(panda, name, shape, shift=(0.0, 0.2, 0.0), **fields):
    place = tool(panda, panda.home).translation + np.array(shift)
    return Obstacle.at(name, shape, place, pin.rpy.rpyToMatrix(0.3, 0.2, 0.1), **fields)


# --- as if it had been there from the start -----------------------------------------------------------------------


@pytest.mark.parametrize("name", [*SHAPES, "mesh"])
def test_added_obstacle_is_one_from_the_start(panda, name, tmp_path):
    shape = SHAPES.get(name)
    if shape is None:
        lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
        faces = ["1 2 3", "2 4 3", "5 7 6", "6 7 8", "1 5 2", "2 5 6", "3 4 7", "4 8 7", "1 3 5", "3 7 5", "2 6 4"]
        path = tmp_path / "block.obj"
        path.write_text("\n".join([*lines, *[f"f {face}" for face in faces]]))
        shape = Mesh(path=str(path), method="convex")
    post = Obstacle.at("post", Cylinder(radius=0.03, length=0.4), [0.45, -0.35, 0.3])
    thing = beside(panda, "thing", shape)
    built, grown = controller_of(panda, [post, thing]), controller_of(panda, [post], spare=3)
    grown.add_obstacle(thing)
    (expected, said, last), (vs, also_said, tick) = loop(panda, built), loop(panda, grown)
    np.testing.assert_allclose(vs, expected, atol=1e-12)
    assert said == also_said
    pairs = [{frozenset(t.problem.pair_names[i]) for i in t.proximity.pair} for t in (last, tick)]
    assert pairs[0] == pairs[1] and any("thing" in pair for pair in pairs[0])
    free, _, _ = loop(panda, controller_of(panda, [post]))
    assert np.abs(expected - free).max() > 0.05, "the obstacle must be in the way, or this shows nothing"


def test_added_external_obstacle_is_one_from_the_start(panda):
    """It comes at the arm: updates, estimated twists, backup trajectories, and the stop once it is silent."""
    ball, place = beside(panda, "ball", Sphere(radius=0.06), external=True), tool(panda, panda.home).translation

    def seen(k):
        return {"ball": Pose.at(place + np.array([0.0, 0.6 - 0.005 * k, 0.0]))} if k < 100 else None

    built, grown = controller_of(panda, [ball]), controller_of(panda, spare=2)
    grown.add_obstacle(ball)
    (expected, said, _), (vs, also_said, tick) = (loop(panda, c, 170, seen) for c in (built, grown))
    np.testing.assert_allclose(vs, expected, atol=1e-12)
    assert said == also_said
    assert tick.solution.status is Status.STOPPED and tick.solution.reasons[0].subject == ("ball",)
    assert np.abs(vs).max() > 0.1


def test_added_obstacle_on_a_trajectory_is_one_from_the_start(panda):
    """Without the search for backup trajectories, which begins earlier where a slot leaves room for what is held."""
    place = tool(panda, panda.home).translation
    start = tuple(place + np.array([0.0, 0.7, 0.0]))
    line = build_motion(Line(start=start, displacement=(0.0, -0.4, 0.0), speed=0.3), None, None)
    ball = Obstacle("ball", Sphere(radius=0.06), line)
    fields = {"avoidance": Avoidance(d1=0.02, d2=0.12, backup=False)}
    built, grown = controller_of(panda, [ball], **fields), controller_of(panda, spare=1, **fields)
    grown.add_obstacle(ball)
    (expected, said, _), (vs, also_said, _) = (loop(panda, c, 170) for c in (built, grown))
    np.testing.assert_allclose(vs, expected, atol=1e-12)
    assert said == also_said and np.abs(vs).max() > 0.1


@pytest.mark.parametrize("shape", [Box(size=(0.06, 0.06, 0.2)), Cylinder(radius=0.03, length=0.2)], ids=["box", "hull"])
def test_added_object_is_grasped_carried_and_released(panda, shape):
    hand = tool(panda, panda.home) * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.13]))
    thing = Obstacle.at("thing", shape, hand.translation, hand.rotation, graspable=True)
    pole = beside(panda, "pole", Capsule(radius=0.025, length=0.16), (0.02, 0.18, -0.16))
    built, grown = controller_of(panda, [thing, pole]), controller_of(panda, [pole], spare=2)
    grown.add_obstacle(thing)
    runs = []
    for controller in (built, grown):

        def grasp(k, q, controller=controller):
            if k == 10:
                controller.attach("thing", TCP, q)
            elif k == 110:
                controller.release("thing", q)

        controller.allow_contact("thing", ["panda_hand_0"])
        runs.append((*loop(panda, controller, 160, before=grasp), controller.obstacle_pose("thing").position))
    np.testing.assert_allclose(runs[1][0], runs[0][0], atol=1e-12)
    np.testing.assert_allclose(runs[1][3], runs[0][3], atol=1e-12)
    assert runs[0][1] == runs[1][1]
    assert np.abs(runs[0][3] - hand.translation).max() > 0.05


def test_obstacle_that_is_added_has_rows_with_attached_objects(panda):
    """Both in slots, either one first; not while both are free."""
    place = tool(panda, panda.home).translation + np.array([0.0, 0.0, -0.1])
    for first, second in (("cup", "wall"), ("wall", "cup")):
        controller, shapes = controller_of(panda, spare=3), {"cup": SHAPES["capsule"], "wall": SHAPES["cylinder"]}
        shift = {"cup": np.zeros(3), "wall": np.array([0.15, 0.0, 0.0])}
        for name in (first, second):
            controller.add_obstacle(Obstacle.at(name, shapes[name], place + shift[name], graspable=name == "cup"))
        pairs = []
        for _ in range(2):
            tick = controller.tick(panda.home)
            pairs.append({frozenset(tick.problem.pair_names[i]): i for i in tick.proximity.pair})
            controller.attach("cup", TCP, panda.home)
        both = frozenset(("cup", "wall"))
        assert both not in pairs[0] and both in pairs[1]
        row = tick.proximity.pair.tolist().index(pairs[1][both])
        assert tick.proximity.distance[row] == pytest.approx(0.15 - 0.04 - 0.05, abs=1e-5)


def test_added_object_has_rows_with_points(panda):
    """The spheres of a cloud are selected for what is in a slot, too."""
    hand = tool(panda, panda.home) * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.08]))
    box = Obstacle.at("box", Box(size=(0.06, 0.06, 0.24)), hand.translation, hand.rotation, graspable=True)
    camera = Obstacle.at("camera", PointCloud(), [0, 0, 0])
    tip = tool(panda, panda.home) * np.array([0.0, 0.0, 0.25])
    given, near = {"camera": Points(tip[None], at_rest=True)}, []
    for controller in (controller_of(panda, [camera, box]), controller_of(panda, [camera], spare=2)):
        if "box" not in controller.scene.obstacle_names:
            controller.add_obstacle(box)
        controller.attach("box", TCP, panda.home)
        tick = controller.tick(panda.home, obstacles=given)
        names = [tick.problem.pair_names[i] for i in tick.proximity.pair]
        near.append((tick.solution.v, tick.proximity.distance[names.index(("box", "camera"))]))
    assert near[0][1] == pytest.approx(near[1][1], abs=1e-12)
    np.testing.assert_allclose(near[0][0], near[1][0], atol=1e-12)


# --- in motion ----------------------------------------------------------------------------------------------------


def test_obstacle_that_appears_near_keeps_to_the_accelerations(panda):
    """Within d1 of the moving hand, then removed, another one put into the same slot: no jump of v."""
    controller, seen = controller_of(panda, spare=1), []

    def change(k, q):
        if k in (40, 60, 80, 100):
            if k > 40:
                controller.remove_obstacle(f"ball{k - 20}")
            place = tool(panda, q).translation + np.array([0.0, 0.0, 0.04 if k == 80 else -0.07])
            controller.add_obstacle(Obstacle.at(f"ball{k}", SHAPES["sphere"], place - [0, 0, 0.09]))
        seen.append(controller.scene.obstacle_names)

    vs, said, tick = loop(panda, controller, 130, before=change)
    names = {name for pair in tick.problem.pair_names for name in pair}
    assert "ball100" in names and "ball80" not in names and seen[45] == ["ball40"]
    excess = (accelerations(vs, DT) - panda.bounds().acceleration).max(axis=1)
    allowed = [any(ReasonKind.ACCELERATION_RELAXED.value in reason for reason in reasons) for reasons in said]
    assert (excess[~np.array(allowed)] <= 1e-6).all() and sum(allowed) <= 3
    assert np.abs(vs).max() > 0.1


def test_removed_obstacle_leaves_nothing(panda):
    ball = beside(panda, "ball", Sphere(radius=0.07))
    clean, used = controller_of(panda), controller_of(panda, spare=2)
    used.add_obstacle(ball)
    used.allow_contact("ball", ["panda_hand_0"])
    used.step(panda.home, obstacles={"ball": Sample.at([0.5, 0.3, 0.5], linear=[0, -0.1, 0])})
    used.remove_obstacle("ball")
    used.reset()
    np.testing.assert_array_equal(loop(panda, used)[0], loop(panda, clean)[0])
    used.add_obstacle(ball)
    used.reset()
    built = controller_of(panda, [ball])
    np.testing.assert_allclose(loop(panda, used)[0], loop(panda, built)[0], atol=1e-12)


def test_a_tick_keeps_the_names_of_its_time(panda):
    controller = controller_of(panda, spare=1)
    controller.add_obstacle(beside(panda, "one", Sphere(radius=0.05), (0.0, 0.1, 0.0)))
    tick = controller.tick(panda.home)
    controller.remove_obstacle("one")
    controller.add_obstacle(beside(panda, "two", Sphere(radius=0.05), (0.0, 0.1, 0.0)))
    later = controller.tick(panda.home)
    for name, then in (("one", tick), ("two", later)):
        found = {name for i in then.proximity.pair for name in then.problem.pair_names[i]} & {"one", "two"}
        assert found == {name}


def test_distances_know_what_is_added(panda):
    controller = controller_of(panda, spare=2)
    query, found, forward = controller.distances(), [], ForwardKinematics(panda.model)
    forward.compute(panda.home)
    controller.add_obstacle(beside(panda, "thing", Sphere(radius=0.05)))
    for distances in (query, controller.distances()):
        distances.compute(forward.joint_poses, 1.0)
        pairs = [i for i in distances.pairs.tolist() if "thing" in controller.scene.pair_names[i]]
        found.append(distances.distances_of(np.array(pairs, dtype=np.intp)))
    np.testing.assert_allclose(*found, atol=1e-15)
    assert len(found[0]) > 10


def test_recorder_knows_what_comes_and_goes(panda, tmp_path):
    scenario = load_scenario("panda_line").model_copy(update={"obstacles": []})
    controller = controller_of(panda, spare=1)
    recorder = Recorder(controller, scenario, 60)
    for k in range(60):
        if k == 20:
            controller.add_obstacle(beside(panda, "one", Sphere(radius=0.05), (0.0, 0.15, 0.0)))
        if k == 40:
            controller.remove_obstacle("one")
            controller.add_obstacle(beside(panda, "two", Box(size=(0.1, 0.1, 0.1)), (0.0, -0.16, 0.0)))
        recorder.add(controller.tick(panda.home, k * DT))
    log = recorder.log()
    assert [obstacle["name"] for obstacle in log.meta["obstacles"]] == ["one", "two"]
    there = np.isfinite(log.obstacle_position[:, :, 0])
    np.testing.assert_array_equal(there.T, [[20 <= k < 40 for k in range(60)], [k >= 40 for k in range(60)]])
    closest = [log.meta["pairs"][log.closest_pair[k]] for k in (30, 50)]
    assert "one" in closest[0] and "two" in closest[1]
    assert len(plot_run(log, tmp_path)) + len(plot_compare([log], tmp_path)) > 4


# --- refusals -----------------------------------------------------------------------------------------------------


def refusals(panda):
    ball = Sphere(radius=0.05)
    return {
        "there is an obstacle 'wall'": Obstacle.at("wall", ball, [1, 0, 0]),
        "is the name of a body of panda": Obstacle.at("panda_hand_0", ball, [1, 0, 0]),
        "give it a name": Obstacle.at("", ball, [1, 0, 0]),
        "a half_space cannot be added": Obstacle.at("floor", HalfSpace(), [0, 0, 0]),
        "a point_cloud cannot be added": Obstacle.at("cloud", PointCloud(), [0, 0, 0]),
        "no such file": Obstacle.at("mesh", Mesh(path="nowhere.stl"), [0, 0, 0]),
        "give a shape": Obstacle.at("ball", 0.05, [0, 0, 0]),
        "farther away than": Obstacle.at("ball", ball, [1e7, 0, 0]),
        "no rotation": Obstacle(
            "ball", ball, still(Sample([1, 0, 0], 2 * np.eye(3), np.zeros(3), np.zeros(3))), moves=False
        ),
        "uncertainty": Obstacle("ball", ball, still(Sample.at([1, 0, 0])), moves=False, uncertainty=np.nan),
        "give an `Obstacle.at": ball,
    }


def test_refused_obstacles_change_nothing(panda):
    wall = Obstacle.at("wall", Box(size=(0.02, 0.5, 0.5)), [0.8, 0.0, 0.4])
    clean, tried = (controller_of(panda, [wall], spare=2) for _ in range(2))
    for message, obstacle in refusals(panda).items():
        with pytest.raises(ConfigError, match=message) as error:
            tried.add_obstacle(obstacle)
        assert "\n" not in str(error.value)
    with pytest.raises(UnknownName, match=r"no obstacle 'wal'.*wall"):
        tried.remove_obstacle("wal")
    with pytest.raises(ConfigError, match="'wall' was built into the scene"):
        tried.remove_obstacle("wall")
    np.testing.assert_array_equal(loop(panda, tried, 30)[0], loop(panda, clean, 30)[0])


def test_full_pool_and_attached_objects_are_refused_with_the_remedy(panda):
    controller, ball = controller_of(panda, spare=2), Sphere(radius=0.03)
    for name in "ab":
        controller.add_obstacle(beside(panda, name, ball, (0, 0, 0.08), graspable=name == "a"))
    with pytest.raises(ConfigError, match="all 2 spare slots are taken; remove an obstacle"):
        controller.add_obstacle(Obstacle.at("c", ball, [1, 0, 0]))
    controller.attach("a", TCP)
    with pytest.raises(ConfigError, match="'a' is attached to the robot; release it first"):
        controller.remove_obstacle("a")
    with pytest.raises(ConfigError, match="'b' cannot be carried"):
        controller.attach("b", TCP)
    controller.release("a")
    controller.remove_obstacle("a")
    controller.add_obstacle(Obstacle.at("c", ball, [1, 0, 0]))
    assert controller.scene.obstacle_names == ["c", "b"]
    with pytest.raises(UnknownName):
        controller.step(panda.home, obstacles={"a": Sample.at([1, 0, 0])})
    with pytest.raises(ConfigError, match="all 0 spare slots"):
        controller_of(panda).add_obstacle(Obstacle.at("c", ball, [1, 0, 0]))
    for wrong in (-1, 1000, 2.0, True):
        with pytest.raises(ConfigError, match=r"^spare_obstacles"):
            build_scene(panda, spare_obstacles=wrong)


def test_scenario_may_have_spare_slots():
    scenario = load_scenario("panda_line").model_copy(update={"spare_obstacles": 1})
    controller, q = Controller.from_scenario(scenario)
    names = controller.scene.obstacle_names
    controller.add_obstacle(Obstacle.at("late", Sphere(radius=0.05), [0.0, 0.0, 2.0]))
    assert sorted(controller.scene.obstacle_names) == sorted([*names, "late"])
    assert controller.step(q).status is Status.SOLVED


def test_controllers_of_one_scene_have_slots_of_their_own(panda):
    scene, tasks = build_scene(panda, spare_obstacles=1), build_tasks([Task(frame=TCP)], panda, panda.home)
    one, other = Controller(scene, tasks), Controller(scene, tasks)
    one.add_obstacle(beside(panda, "ball", Sphere(radius=0.05)))
    assert one.scene.obstacle_names == ["ball"] and scene.obstacle_names == other.scene.obstacle_names == []
    other.add_obstacle(beside(panda, "ball", Sphere(radius=0.05)))


def test_a_thousand_obstacles_leave_no_trace(tmp_path):
    controller = make_controller(cartesian(tmp_path), (), "z", avoidance=Avoidance(d1=0.02, d2=0.1))
    scene = build_scene(controller.scene.robot, spare_obstacles=3)
    controller, counts = Controller(scene, controller.tasks, dt=DT), []
    shapes, q = list(SHAPES.values()), np.zeros(3)
    for k in range(1000):
        name = f"thing{k}"
        controller.add_obstacle(Obstacle.at(name, shapes[k % len(shapes)], [0.3, 0.0, 0.0], graspable=k % 2 == 0))
        controller.step(q, obstacles={name: Pose.at([0.3, 0.0, 0.0])} if k % 3 == 0 else None)
        if k % 2 == 0:
            controller.attach(name, "z", q)
            controller.release(name, q)
        controller.remove_obstacle(name)
        if k in (200, 999):
            gc.collect()
            counts.append(len(gc.get_objects()))
    assert counts[1] - counts[0] < 50
    assert controller.scene.obstacle_names == [] and not controller.attached
    fresh = Controller(scene, controller.tasks, dt=DT)
    for c in (controller, fresh):
        c.reset()
    targets = {"z": Sample.at([0.5, 0.1, 0.0])}
    np.testing.assert_array_equal(controller.step(q, targets=targets).v, fresh.step(q, targets=targets).v)
