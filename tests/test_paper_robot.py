"""The URDF of the paper's robot against the product of exponentials of eq. 1, written here from Table 1."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "robots" / "paper-dual-arm"
URDF = FOLDER / "paper_dual_arm.urdf"
SIDES = ("left", "right")
NAMES = [f"{side}_joint{i}" for side in SIDES for i in range(1, 8)]

L0, L1, L2, L3, L4 = 1.20, 0.30, 0.35, 0.30, 0.25
S1 = 0.17  # any value: s1 lies along the axes of joints 2, 4 and 6, so nothing may depend on it

ATOL = 1e-12
Q0_SITUATION_1 = np.array([-1.18, 1.13, 0.14, -1.02, 1.45, -1.07, -1.44])


@pytest.fixture(scope="module")
def model() -> Any:
    """Return the committed URDF as a Pinocchio model with a fixed base."""
    return pin.buildModelFromUrdf(str(URDF))


def table_1(side: str) -> tuple[Array, Array]:
    """Return the axis directions (7, 3) and the points on them (7, 3) [m] of Table 1, in the world."""
    y = L1 if side == "left" else -L1
    omega_1 = [0, 1, 0] if side == "left" else [0, -1, 0]
    omega = [omega_1, [1, 0, 0], [0, 0, -1], [1, 0, 0], [0, 0, -1], [1, 0, 0], [0, 0, -1]]
    points = [
        [0, y, L0],
        [S1, y, L0],
        [0, y, 0],
        [S1, y, L0 - L2],
        [0, y, 0],
        [S1, y, L0 - L2 - L3],
        [0, y, 0],
    ]
    return np.array(omega, dtype=float), np.array(points, dtype=float)


def exponential(omega: Array, point: Array, angle: float) -> Array:
    """Return exp(xi angle), (4, 4): a turn about the line through `point` along the unit vector `omega`."""
    x, y, z = omega
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    transform = np.eye(4)
    transform[:3, :3] += np.sin(angle) * hat + (1.0 - np.cos(angle)) * hat @ hat  # Rodrigues
    transform[:3, 3] = point - transform[:3, :3] @ point  # the line itself stays where it is
    return transform


def product_of_exponentials(side: str, angles: Array) -> tuple[Array, Array]:
    """Return the tool pose (4, 4) of eq. 1 and the space Jacobian (6, 7) of rows [v; omega], in the world.

    Column i of the Jacobian is Ad(e^{xi_1 theta_1} ... e^{xi_i-1 theta_i-1}) xi_i, that is the line of axis i
    moved by the joints before it.
    """
    y = L1 if side == "left" else -L1
    pose = np.eye(4)
    columns = []
    for omega, point, angle in zip(*table_1(side), angles, strict=True):
        direction = pose[:3, :3] @ omega
        position = pose[:3, :3] @ point + pose[:3, 3]
        columns.append(np.concatenate([np.cross(position, direction), direction]))
        pose = pose @ exponential(omega, point, angle)
    home = np.eye(4)
    home[:3, 3] = [0.0, y, L0 - L2 - L3 - L4]
    return pose @ home, np.stack(columns, axis=1)


def frame_pose(model: Any, frame: str, q: Array) -> Array:
    """Return the pose (4, 4) of `frame` in the world at the joint vector `q` (14,)."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.asarray(data.oMf[model.getFrameId(frame)].homogeneous)


def test_committed_urdf_is_what_the_generator_renders() -> None:
    render = runpy.run_path(str(FOLDER / "generate.py"))["render"]
    assert URDF.read_bytes() == render().encode()


def test_joint_order_and_limits(model: Any) -> None:
    assert list(model.names) == ["universe", *NAMES]
    assert model.nq == model.nv == 14
    assert [model.joints[i + 1].idx_v for i in range(14)] == list(range(14))
    np.testing.assert_array_equal(model.upperPositionLimit, 3.1415926)
    np.testing.assert_array_equal(model.lowerPositionLimit, -3.1415926)
    np.testing.assert_array_equal(model.upperVelocityLimit, 2.0)
    np.testing.assert_array_equal(model.upperEffortLimit, 100.0)


@pytest.mark.parametrize("side", SIDES)
def test_tool_pose_and_jacobian_are_those_of_the_product_of_exponentials(model: Any, side: str) -> None:
    arm = slice(0, 7) if side == "left" else slice(7, 14)
    data, frame = model.createData(), model.getFrameId(f"{side}_tool")
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (100, 14)):
        jacobian = np.zeros((6, 14))  # the other arm does not move this tool
        pose, jacobian[:, arm] = product_of_exponentials(side, q[arm])
        np.testing.assert_allclose(frame_pose(model, f"{side}_tool", q), pose, rtol=0, atol=ATOL)
        found = pin.computeFrameJacobian(model, data, q, frame, pin.ReferenceFrame.WORLD)
        np.testing.assert_allclose(found, jacobian, rtol=0, atol=ATOL)


def test_start_of_situation_1(model: Any) -> None:
    q = np.concatenate([Q0_SITUATION_1, np.zeros(7)])
    tool = frame_pose(model, "left_tool", q)[:3, 3]
    np.testing.assert_allclose(tool, [0.396449, 0.650901, 0.747414], rtol=0, atol=1e-6)


def test_collision_cylinders_run_from_centre_to_centre(model: Any) -> None:
    """Each arm has three, of radius 0.05 m: joints 2 to 4, 4 to 6, and 6 to the tool (section 2.2)."""
    geometry = pin.buildGeomFromUrdf(model, str(URDF), pin.GeometryType.COLLISION)
    assert geometry.ngeoms == 6
    data, placements = model.createData(), geometry.createData()
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (5, 14)):
        pin.framesForwardKinematics(model, data, q)
        pin.updateGeometryPlacements(model, data, geometry, placements, q)
        for side in SIDES:
            centres = [f"{side}_link2", f"{side}_link4", f"{side}_link6", f"{side}_tool"]
            points = [data.oMf[model.getFrameId(name)].translation for name in centres]
            for link, upper, lower in zip((3, 5, 7), points, points[1:], strict=False):
                index = geometry.getGeometryId(f"{side}_link{link}_0")
                cylinder, placement = geometry.geometryObjects[index].geometry, placements.oMg[index]
                assert cylinder.radius == 0.05
                ends = [placement.act(np.array([0.0, 0.0, z * cylinder.halfLength])) for z in (1, -1)]
                np.testing.assert_allclose(ends, [upper, lower], rtol=0, atol=ATOL)
