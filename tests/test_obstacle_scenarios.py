"""Scenarios that ship with clouds, half-spaces, meshes and loads; what their logs and figures show."""

import numpy as np
import pytest

from qpavoid import ConfigError, Controller, Log, load_scenario
from qpavoid.run.simulate import simulate
from qpavoid.viz.motion import motion_figure
from qpavoid.viz.surfaces import local_faces, shape_faces


@pytest.fixture(scope="module")
def carried():
    return {solver: simulate("carried_box", solver) for solver in ("tracking", "qp")}


def test_attached_object_changes_the_path(carried):
    """Tracking takes the box through the pole, with the hand itself clear of it; the QP takes both past it."""
    tracking, qp = (carried[solver].metrics() for solver in ("tracking", "qp"))
    assert tracking["collided"] and tracking["min_pair"] == ["box", "pole"]
    assert not qp["collided"] and qp["min_distance"] > 0.02 - 1e-3
    assert qp["final_error"] < 1e-3 and qp["status_counts"]["SOLVED"] == len(carried["qp"].t)


def test_attached_object_is_logged_at_its_pose(carried):
    """A load is logged where the robot has it."""
    log = carried["qp"]
    index = [o["name"] for o in log.meta["obstacles"]].index("box")
    away = np.einsum(
        "nji,nj->ni", log.tool_rotation[:, 0], log.obstacle_position[:, index] - log.tool[:, 0]
    )  # in the tool's axes
    np.testing.assert_allclose(away, np.broadcast_to(away[0], away.shape), atol=1e-9)
    assert np.ptp(log.obstacle_position[:, index], axis=0).max() > 0.5


def test_point_cloud_shelf_is_avoided():
    """A shelf seen as points."""
    log = simulate("shelf", "qp")
    metrics = log.metrics()
    assert metrics["min_distance"] > 0.02 - 1e-3 and metrics["status_counts"]["SOLVED"] == len(log.t)
    assert any("shelf" in log.meta["pairs"][pair] for pair in set(log.closest_pair.tolist()))


def test_figures_of_shapes_from_files(carried, tmp_path):
    """Figures show what came from files."""
    log = Log.load(carried["qp"].save(tmp_path / "run"))
    shelf = next(o for o in log.meta["obstacles"] if o["name"] == "shelf")
    faces = local_faces(shelf).reshape(-1, 3)
    np.testing.assert_allclose(faces.min(axis=0), [-0.45, -0.15, 0.0], atol=1e-4)
    np.testing.assert_allclose(faces.max(axis=0), [0.45, 0.15, 0.9], atol=1e-4)
    assert len(motion_figure(log).axes) == 6


@pytest.mark.parametrize(
    ("shape", "extent"),
    [
        ({"type": "cone", "radius": 0.1, "length": 0.4}, [0.2, 0.2, 0.4]),
        ({"type": "ellipsoid", "radii": [0.1, 0.2, 0.3]}, [0.2, 0.4, 0.6]),
    ],
)
def test_faces_of_shapes_look_outwards(shape, extent):
    faces = shape_faces(shape)
    np.testing.assert_allclose(np.ptp(faces.reshape(-1, 3), axis=0), extent, rtol=0.02)
    normals = np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    assert (np.einsum("ij,ij->i", normals, faces.mean(axis=1)) >= -1e-9).all()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("obstacles.0.attached_to=panda_hand_tpc", "attached_to: .*did you mean 'panda_hand_tcp'"),
        ("obstacles.0.attached_to=universe", "attached_to: attach: frame 'universe' is fixed to the world"),
        ("obstacles.3.attached_to=panda_hand_tcp", "a half_space cannot be carried"),
        ("obstacles.2.graspable=true", "method: convex"),
        ("obstacles.0.motion.position=[3, 0, 0]", "too far to be carried"),
    ],
)
def test_attach_errors_name_file_and_field(override, message):
    """What cannot be carried is said with file and field."""
    with pytest.raises(ConfigError, match=message) as caught:
        Controller.from_scenario(load_scenario("carried_box", [override]))
    assert "carried_box.yaml" in str(caught.value)
