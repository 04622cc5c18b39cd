"""Shapes of obstacles against support functions and closed forms: apart, in penetration, at ties; files of meshes."""

import numpy as np
import pinocchio as pin
import pytest
from closed_loop import cartesian, drive, make_controller
from conftest import BOX, SPHERE, Bench, differences, look, moved, obstacle, random_q, write_chain
from oracle import signed_distance, support
from urdfs import write_stl

from qpavoid import (
    Avoidance,
    ConfigError,
    Controller,
    Obstacle,
    ReasonKind,
    Robot,
    Sample,
    Severity,
    Status,
    build_scene,
    config,
    load_scenario,
)
from qpavoid.config import Cone, Ellipsoid, HalfSpace, Mesh
from qpavoid.geometry.meshes import MeshWarning
from qpavoid.run.simulate import simulate

CONE = Cone(radius=0.09, length=0.25)
ELLIPSOID = Ellipsoid(radii=(0.1, 0.16, 0.07))
FLOOR = HalfSpace()
CYLINDER = config.Cylinder(radius=0.07, length=0.25)
BODIES = {
    "sphere": {"type": "sphere", "radius": 0.06}, "capsule": {"type": "capsule", "radius": 0.05, "length": 0.2},
    "box": {"type": "box", "size": [0.1, 0.2, 0.14]}, "cylinder": {"type": "cylinder", "radius": 0.06, "length": 0.2},
    "cone": {"type": "cone", "radius": 0.08, "length": 0.2},
    "ellipsoid": {"type": "ellipsoid", "radii": [0.05, 0.1, 0.08]},
}  # fmt: skip
CURVED = 1.5e-4
"""coal iterates to curved surfaces; its default tolerance on them is 1e-6 of the squared distance."""


def boards(*boxes):
    """Triangles of boxes (centre, size), one mesh."""
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
             (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
    return np.concatenate([(corner * size + center)[faces] for center, size in boxes])


SHELF = [((0, 0, z), (0.8, 0.3, 0.02)) for z in (0.01, 0.4, 0.79)] + [
    ((x, 0, 0.4), (0.02, 0.3, 0.8)) for x in (-0.39, 0.39)
]


@pytest.fixture
def shelf(tmp_path):
    return write_stl(tmp_path / "shelf.stl", boards(*SHELF))


def tool(folder, shape):
    return cartesian(folder, shape=shape)


def placed(scene, q):
    data = scene.robot.model.createData()
    pin.forwardKinematics(scene.robot.model, data, q)
    return [data.oMi[body.parentJoint] * body.placement for body in scene.geometry.geometryObjects]


# --- signed distances --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("shape", [CONE, ELLIPSOID, BOX, CYLINDER], ids=lambda shape: shape.type)
def test_distances_and_normals_are_those_of_the_support_functions(tmp_path, body, shape):
    """Apart and in penetration, the centre of one inside the other included."""
    rng, robot = np.random.default_rng(3), tool(tmp_path, BODIES[body])
    scene = build_scene(robot, [obstacle("it", shape, (0, 0, 0), rng.uniform(-3, 3, 3))])
    shapes = [b.geometry for b in scene.geometry.geometryObjects]
    apart = inside = 0
    for _ in range(25):
        q = rng.uniform(-0.25, 0.25, 3) * rng.choice([0.3, 1.0])
        found, (a, b) = look(scene, q), placed(scene, q)
        expected, _ = signed_distance(support(shapes[0], a), support(shapes[1], b))
        assert found.distance[0] == pytest.approx(expected, abs=CURVED)
        n = found.normal
        along = -(support(shapes[0], a)(n) + support(shapes[1], b)(-n))[0]  # the gap that this normal sees
        assert along == pytest.approx(expected, abs=CURVED)
        np.testing.assert_allclose(found.point_b - found.point_a, found.distance[:, None] * n, atol=1e-9)
        assert (found.point_a @ n[0])[0] == pytest.approx(support(shapes[0], a)(n)[0], abs=CURVED)
        apart, inside = apart + (expected > 0), inside + (expected < 0)
    assert apart > 3 and inside > 3


@pytest.mark.parametrize("body", BODIES)
def test_half_spaces_have_a_closed_form(tmp_path, body):
    rng, robot = np.random.default_rng(4), tool(tmp_path, BODIES[body])
    for _ in range(10):
        at, rpy = rng.uniform(-0.5, 0.5, 3), rng.uniform(-3, 3, 3)
        scene = build_scene(robot, [obstacle("wall", FLOOR, at, rpy)])
        up = pin.rpy.rpyToMatrix(*rpy)[:, 2]
        for _ in range(5):
            q = rng.uniform(-0.6, 0.6, 3)
            found, (a, _) = look(scene, q), placed(scene, q)
            lowest = -support(scene.geometry.geometryObjects[0].geometry, a)(-up[None])[0]
            assert found.distance[0] == pytest.approx(lowest - up @ at, abs=1e-9)
            np.testing.assert_allclose(found.normal[0], -up, atol=1e-12)
            np.testing.assert_allclose(found.J[0], up, atol=1e-12)


@pytest.mark.parametrize(("shape", "tolerance"), [(CONE, 1e-4), (ELLIPSOID, 1e-4), (FLOOR, 1e-6)])
def test_rows_by_finite_differences(panda, shape, tolerance):
    rng = np.random.default_rng(7)
    scene = build_scene(panda, [obstacle("it", shape, (0.5, 0.1, 0.3), (0.3, 0.2, 0.5))])
    mine = scene.pairs[:, 1] == len(scene.body_names)
    for _ in range(5):
        q = random_q(panda, rng)
        found = look(scene, q)
        expected = differences(lambda q: look(scene, q).distance, panda, q, step=1e-5)
        smooth = mine & (np.abs(found.distance) > 1e-3)
        np.testing.assert_allclose(found.J[smooth], expected[smooth], atol=tolerance)


# --- bounding spheres without end ---------------------------------------------------------------------------------


def test_half_spaces_are_near_wherever_they_are(panda):
    rng = np.random.default_rng(8)
    scene = build_scene(panda, [obstacle("floor", FLOOR, (0, 0, -0.1)), obstacle("ball", SPHERE, (0.6, 0, 0.3))])
    bench, data, placed = Bench(scene), panda.model.createData(), scene.geometry.createData()
    for reach in (0.1, 0.5, np.inf):
        for _ in range(5):
            q = random_q(panda, rng)
            pin.updateGeometryPlacements(panda.model, data, scene.geometry, placed, q)
            pin.computeDistances(scene.geometry, placed)
            expected = np.array([result.min_distance for result in placed.distanceResults])
            found = look(scene, q, reach=reach, bench=bench)
            np.testing.assert_array_equal(found.pair, np.flatnonzero(expected < reach))
            np.testing.assert_allclose(found.distance, expected[found.pair], atol=1e-6)
    assert "floor" in {scene.pair_names[pair][1] for pair in found.pair}


@pytest.mark.parametrize("shape", [SPHERE, BOX, CONE, FLOOR])
def test_what_passes_close_by_is_known_not_to_come_nearer(panda, shape):
    """Along the normals the bound is close enough to tell, where the fastest points of the bodies would not be."""
    rng = np.random.default_rng(20)
    scene = build_scene(panda, [obstacle("it", shape, (9.0, 0.0, 0.0))])
    bench, warned, close = Bench(scene), 0, 0
    for _ in range(1500):
        q, v = random_q(panda, rng), rng.uniform(-0.5, 0.5, 7)
        sample = Sample.at(
            rng.uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 0.9]), pin.exp3(rng.uniform(-2, 2, 3)),
            *(rng.choice([0.0, 0.3]) * rng.uniform(-1, 1, 3) for _ in range(2)),
        )  # fmt: skip
        bench.place({0: sample})
        proximity = bench.compute(q, reach=0.1)[0]
        gap = proximity.distance.min(initial=np.inf) - Avoidance().d1
        if not 0.0 < gap < 0.01:
            continue
        close += 1
        least = bench.assembler.clearance_lower_bound(v, len(proximity.pair), 0.02)
        warned += least > 0.0
        for t in (0.005, 0.01, 0.02):
            found = look(scene, pin.integrate(panda.model, q, t * v), {0: moved(sample, t)}, 0.1)
            assert found.distance.min(initial=0.1) - Avoidance().d1 >= least - 1e-9
    assert close > 10 and warned > 0.1 * close


@pytest.mark.parametrize("angular", [None, [0.0, 0.3, 0.0]])
def test_full_speed_towards_the_ground_stops_short_of_it(tmp_path, angular):
    """Also where the ground tips towards the robot: the look ahead takes both into account, and ends."""
    robot = cartesian(tmp_path, speed=2.0, acceleration=4.0, shape=BODIES["capsule"])
    controller = make_controller(robot, [Obstacle.at("ground", FLOOR, [0, 0, -1.0])], "z", task={"gain": 20.0})
    updates = None if angular is None else {"ground": Sample.at([0, 0, -1.0], angular=angular)}
    for tick in drive(
        controller, np.zeros(3), 150, target=[0, 0, -3.0], obstacles=None if updates is None else lambda t: updates
    ):
        bottom = tick.state.q[2] + 0.01 * tick.solution.v[2] - 0.15
        assert bottom + 1.0 > 0.02 - 1e-3
        assert tick.solution.status is Status.SOLVED
    assert bottom + 1.0 < 0.15


# --- meshes -------------------------------------------------------------------------------------------------------


def test_a_decomposed_mesh_is_its_boards(tmp_path, shelf):
    """Distances to a shelf are those to its five boards: a body goes between them."""
    robot, rng = tool(tmp_path, BODIES["capsule"]), np.random.default_rng(10)
    whole = build_scene(robot, [Obstacle.at("shelf", Mesh(path=str(shelf)), [0, 0, 0])])
    apart = [obstacle(f"b{i}", config.Box(size=size), center) for i, (center, size) in enumerate(SHELF)]
    pieces = build_scene(robot, apart)
    assert len(whole.pairs) == len(pieces.pairs) == 5
    assert {name for _, name in whole.pair_names} == {"shelf"}
    for _ in range(30):
        q = rng.uniform([-0.5, -0.3, -0.1], [0.5, 0.3, 0.9])
        d, expected = look(whole, q).distance.min(), look(pieces, q).distance.min()
        if expected > 0.0:
            assert d == pytest.approx(expected, abs=1e-5)
        else:  # the depth in a corner where boards meet depends on how it is cut
            assert d < 1e-5
    assert look(whole, np.array([0.0, 0.0, 0.22])).distance.min() > 0.0  # the capsule stands on the board


@pytest.mark.parametrize("method", ["convex", "decomposed", "surface"])
@pytest.mark.filterwarnings("ignore::qpavoid.geometry.meshes.MeshWarning")
def test_meshes_move_and_turn_like_any_other_obstacle(tmp_path, method):
    path = write_stl(tmp_path / "box.stl", boards(((0, 0, 0), (200.0, 300.0, 100.0))))
    mesh = Mesh(path=str(path), scale=1e-3, method=method)
    robot, rng = tool(tmp_path, BODIES["capsule"]), np.random.default_rng(11)
    scenes = [build_scene(robot, [Obstacle.at("it", shape, [0, 0, 0])]) for shape in (mesh, BOX)]
    for _ in range(10):
        q = rng.uniform(-0.4, 0.4, 3)
        sample = Sample.at(
            rng.uniform(-0.3, 0.3, 3), pin.rpy.rpyToMatrix(*rng.uniform(-3, 3, 3)), rng.uniform(-1, 1, 3)
        )
        found, expected = (look(scene, q, {0: sample}) for scene in scenes)
        if expected.distance[0] < 0.0 and method == "surface":
            assert np.isnan(found.distance[0])
            continue
        assert found.distance[0] == pytest.approx(expected.distance[0], abs=1e-5)
        np.testing.assert_allclose(found.normal, expected.normal, atol=1e-4)
        np.testing.assert_allclose(found.feedforward, expected.feedforward, atol=1e-4)


def test_a_cut_surface_stops_the_robot_and_says_so(tmp_path):
    path = write_stl(tmp_path / "box.stl", boards(((0, 0, 0), (0.2, 0.2, 0.2))))
    with pytest.warns(MeshWarning, match="100 to 500 µs a pair"):
        scene_obstacle = Obstacle.at("it", Mesh(path=str(path), method="surface"), [0.5, 0, 0])
        controller = make_controller(tool(tmp_path, BODIES["sphere"]), [scene_obstacle], "z")
    inside = controller.step(np.array([0.5, 0.09, 0.0]))
    assert inside.status is Status.STOPPED
    for reason in inside.reasons:
        assert (reason.kind, reason.subject) == (ReasonKind.UNKNOWN_DISTANCE, ("tool", "it"))
        assert reason.severity is Severity.ALARM
    assert controller.step(np.array([0.0, 0.0, 0.0])).status is Status.SOLVED


@pytest.mark.filterwarnings("ignore::qpavoid.model.notes.RobotWarning")
def test_two_triangle_meshes_have_normals(tmp_path):
    """coal leaves the normal of two meshes unset: rows of `bodies: mesh` used to be zero."""
    write_stl(tmp_path / "part.stl", boards(((0, 0, 0.15), (0.04, 0.04, 0.16))))
    robots = {
        kind: Robot.from_urdf(write_chain(tmp_path, joints=3, shape='<mesh filename="part.stl"/>'), bodies=kind)
        for kind in ("mesh", "convex")
    }
    rng = np.random.default_rng(12)
    for _ in range(10):
        q = rng.uniform(-1.5, 1.5, 3)
        found, expected = (look(build_scene(robot), q) for robot in robots.values())
        clear = expected.distance > 1e-3
        np.testing.assert_allclose(found.distance[clear], expected.distance[clear], atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(found.normal[clear], axis=1), 1.0, atol=1e-12)
        step = differences(lambda q: look(build_scene(robots["mesh"]), q).distance, robots["mesh"], q, 1e-5)
        np.testing.assert_allclose(found.J[clear], step[clear], atol=1e-3)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"path": "no.stl"}, r"^\S*run.yaml: obstacles: 'it': shape.path: no such file 'no.stl'"),
        ({"path": "junk.stl"}, r"^\S*run.yaml: obstacles: 'it': shape.path: junk.stl"),
        ({"path": "part.stl", "method": "hollow"}, "method"),
        ({"path": "part.stl", "scale": -1.0}, "scale"),
    ],
)
def test_bad_meshes_are_refused_in_one_line(tmp_path, field, message):
    write_stl(tmp_path / "part.stl", boards(((0, 0, 0), (0.2, 0.2, 0.2))))
    (tmp_path / "junk.stl").write_bytes(b"\x00\x01 nothing of the kind" * 20)
    path = tmp_path / "run.yaml"
    path.write_text(
        "robot: panda\ntasks: [{frame: panda_hand_tcp}]\nduration: 0.1\nobstacles:\n"
        f"  - {{name: it, shape: {{type: mesh, {', '.join(f'{k}: {v}' for k, v in field.items())}}}, "
        "motion: {type: fixed, position: [1, 0, 0]}}\n"
    )
    with pytest.raises(ConfigError, match=message) as caught:
        Controller.from_scenario(load_scenario(path))
    assert str(path) in str(caught.value)


def test_every_shape_can_be_given_in_a_scenario(tmp_path, shelf):
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).uniform(0.9, 1.1, (200, 3)))
    shapes = [
        "{type: cone, radius: 0.1, length: 0.2}", "{type: ellipsoid, radii: [0.1, 0.2, 0.1]}",
        "{type: mesh, path: shelf.stl}", "{type: mesh, path: shelf.stl, method: convex, scale: 0.1}",
        "{type: point_cloud, path: cloud.npy}",
    ]  # fmt: skip
    rows = [
        f"  - {{name: o{i}, shape: {shape}, motion: {{type: fixed, position: [2, {i}, 0]}}}}"
        for i, shape in enumerate(shapes)
    ]
    rows.append("  - {name: floor, shape: {type: half_space}, motion: {type: fixed, position: [0, 0, -0.2]}}")
    path = tmp_path / "run.yaml"
    path.write_text(
        "robot: panda\ntasks: [{frame: panda_hand_tcp}]\nduration: 0.05\nobstacles:\n" + "\n".join(rows) + "\n"
    )
    log = simulate(load_scenario(path))
    assert log.metrics()["completed"] and log.metrics()["status_counts"]["STOPPED"] == 0
