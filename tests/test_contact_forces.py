"""Contacts and the equations of the base, eliminated: identities of linear algebra and of the equations of motion."""

import numpy as np
import pinocchio as pin
import pytest

from qpavoid import Robot, build_contacts
from qpavoid.config import Contact
from qpavoid.kernels.contact_forces import (
    cone_rows,
    eliminate_base,
    force_torque_rows,
    make_orthonormal,
    point_jacobians,
    standing_dynamics,
)
from qpavoid.kernels.orthogonal import factorise_rows, solve_rows, split_space
from qpavoid.kernels.qp import minimize
from qpavoid.kernels.reduced_qp import project_within
from qpavoid.model.kinematics import ForwardKinematics

DT, SCALE = 1e-3, 0.03
CORNERS = np.array([[-0.05, 0.025, -0.035], [-0.05, -0.025, -0.035], [0.12, 0.03, -0.035], [0.12, -0.03, -0.035]])
FEET = ("left_ankle_roll_link", "right_ankle_roll_link")


@pytest.fixture(scope="module")
def standing():
    """The G1 near home on two feet: M, h, q, v, contact rows and point Jacobians by pinocchio, and what kernels do."""
    robot, rng = Robot.load("g1"), np.random.default_rng(0)
    model, data = robot.model, robot.model.createData()
    q = pin.integrate(model, robot.home, rng.normal(scale=0.05, size=model.nv))
    v = rng.normal(scale=0.1, size=model.nv)
    M = pin.crba(model, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    h = np.array(pin.nonLinearEffects(model, data, q, v))
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    ids = [model.getFrameId(name) for name in FEET]
    J = np.array([pin.getFrameJacobian(model, data, i, pin.LOCAL_WORLD_ALIGNED) for i in ids])
    offsets = np.concatenate([CORNERS @ data.oMf[i].rotation.T for i in ids])
    frames, Jp = np.repeat([0, 1], 4), np.empty((24, model.nv))
    point_jacobians(J, offsets, frames, Jp)
    b = rng.normal(scale=0.01, size=12)
    Z, rest = solve_rows(J.reshape(12, -1), b)
    n, k = Z.shape
    X, start, Y, N = np.empty((n + 24, k + 18)), np.empty(n + 24), np.empty((24, 6)), np.empty((24, 18))
    assert eliminate_base(M, h, v, DT, Jp, Z, rest, SCALE, X, start, Y, N)
    return {
        "model": model, "q": q, "v": v, "M": M, "h": h, "J": J.reshape(12, -1), "b": b, "Jp": Jp, "ids": ids,
        "Z": Z, "rest": rest, "X": X, "start": start, "Y": Y, "N": N,
    }  # fmt: skip


def test_contact_rows_bring_frames_back(standing):
    """Jacobians of pinocchio, the gain times what is missing, of a surface and a point; none off the ground."""
    robot, (foot, other), rng = Robot.load("g1"), FEET, np.random.default_rng(4)
    contacts = build_contacts([Contact(frame=foot, gain=5.0), Contact(frame=other, type="point")], robot, robot.home)
    model, data = robot.model, robot.model.createData()
    kinematics = ForwardKinematics(model, contacts.frame_ids)
    pin.framesForwardKinematics(model, data, robot.home)
    rest = [data.oMf[i].copy() for i in contacts.frame_ids]
    q = pin.integrate(model, robot.home, rng.normal(scale=1e-4, size=model.nv))
    kinematics.compute(q)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    J = [pin.getFrameJacobian(model, data, i, pin.LOCAL_WORLD_ALIGNED) for i in contacts.frame_ids]
    now = [data.oMf[i] for i in contacts.frame_ids]
    turn = pin.log3(rest[0].rotation @ now[0].rotation.T)
    b = np.concatenate((5.0 * (rest[0].translation - now[0].translation), 5.0 * turn))
    found = contacts.update(kinematics)
    np.testing.assert_allclose(found.J, np.concatenate((J[0], J[1][:3])), atol=1e-12)
    np.testing.assert_allclose(found.b, [*b, *(10.0 * (rest[1].translation - now[1].translation))], atol=1e-12)
    contacts.switch([other], 0.0)
    contacts.advance(DT, kinematics)
    np.testing.assert_allclose(contacts.update(kinematics).J, J[1][:3], atol=1e-12)


@pytest.mark.parametrize(("rows", "n", "dependent"), [(6, 24, 0), (12, 35, 0), (9, 20, 5), (20, 20, 0), (24, 10, 0)])
def test_rows_are_factored(rows, n, dependent):
    rng = np.random.default_rng(rows)
    J = rng.normal(size=(rows, n))
    J = np.concatenate((J, rng.normal(size=(dependent, rows)) @ J))
    Q, R, order = np.empty((n, n)), np.empty((n, len(J))), np.empty(len(J), dtype=np.intp)
    assert factorise_rows(J, Q, R, order) == min(rows, n)
    np.testing.assert_allclose(Q.T @ Q, np.eye(n), atol=1e-13)
    np.testing.assert_allclose(Q @ R, J[order].T, atol=1e-12)


def test_basis_and_right_inverse(standing):
    """Bᵀ = Q R: Y is the least right inverse, N what it leaves."""
    B, Y, N = standing["Jp"][:, :6].T, standing["Y"], standing["N"]
    np.testing.assert_allclose(Y, np.linalg.pinv(B), atol=1e-12)
    np.testing.assert_allclose(B @ N, 0.0, atol=1e-13)
    np.testing.assert_allclose(N.T @ N, np.eye(18), atol=1e-13)
    X, own = standing["X"], make_orthonormal(standing["X"], *standing["Z"].shape)
    np.testing.assert_allclose(own.T @ own, np.eye(41), atol=1e-12)
    np.testing.assert_allclose(own @ own.T @ X, X, atol=1e-12)
    np.testing.assert_allclose(standing["J"] @ standing["Z"], 0.0, atol=1e-13)
    np.testing.assert_allclose(standing["J"] @ standing["rest"], standing["b"], atol=1e-13)


def test_point_jacobians_are_those_of_the_points(standing):
    model, data, ids = standing["model"], standing["model"].createData(), standing["ids"]
    for number, (frame, corner) in enumerate([(i, corner) for i in ids for corner in CORNERS]):
        places = []
        for sign in (1.0, -1.0):
            pin.framesForwardKinematics(model, data, pin.integrate(model, standing["q"], sign * 1e-6 * standing["v"]))
            places.append(data.oMf[frame].act(corner))
        speed = standing["Jp"][3 * number : 3 * number + 3] @ standing["v"]
        np.testing.assert_allclose(speed, (places[0] - places[1]) / 2e-6, atol=1e-8)


def test_whatever_is_free_the_base_equations_hold_and_torques_are_those_of_inverse_dynamics(standing):
    """Base equations to 1e-10 N s, τ = rnea(q, v, a) - Jcᵀ f to 1e-9 Nm, f by pinocchio's own external forces."""
    rng, M, h, v = np.random.default_rng(1), standing["M"], standing["h"], standing["v"]
    model, data, n = standing["model"], standing["model"].createData(), len(standing["h"])
    rows, rhs, limit = np.empty((2 * (n - 6), n + 24)), np.empty(2 * (n - 6)), np.full(n - 6, 50.0)
    force_torque_rows(M, h, v, DT, standing["Jp"], limit, SCALE, rows, rhs)
    pin.framesForwardKinematics(model, data, standing["q"])
    for _ in range(20):
        y = rng.normal(scale=1e-3, size=standing["X"].shape[1])
        x = standing["start"] + standing["X"] @ y
        v_end, p = x[:n], x[n:] / SCALE
        base = M[:6] @ (v_end - v) + DT * h[:6] - standing["Jp"][:, :6].T @ p
        assert np.abs(base).max() < 1e-10
        np.testing.assert_allclose(standing["J"] @ v_end, standing["b"], atol=1e-13)
        wrenches = pin.StdVec_Force()
        outside = [pin.Force.Zero() for _ in range(model.njoints)]
        for number, force in enumerate(p.reshape(-1, 3) / DT):
            i = standing["ids"][number // 4]
            point, joint = data.oMf[i].act(CORNERS[number % 4]), model.frames[i].parentJoint
            outside[joint] += data.oMi[joint].actInv(pin.Force(force, np.cross(point, force)))
        for wrench in outside:
            wrenches.append(wrench)
        torque = pin.rnea(model, data, standing["q"], v, (v_end - v) / DT, wrenches)
        assert np.abs(torque[:6]).max() < 1e-7
        weight = np.abs(M[6:]).sum(axis=1)
        from_rows = (rows[::2] @ x - rhs[::2]) * weight / DT - limit
        np.testing.assert_allclose(torque[6:], (M @ (v_end - v) / DT + h - standing["Jp"].T @ p / DT)[6:], atol=1e-9)
        np.testing.assert_allclose(from_rows, torque[6:], atol=1e-3)  # rows keep a margin of 1e-7 in v


def test_what_rows_do_not_move_is_left_as_it_is(standing):
    """Two feet move 18 of 35 coordinates: K and Z together are orthonormal, and the arms are axes of Z."""
    K, Z, _, _ = split_space(standing["J"])
    whole = np.vstack((K, Z.T))
    np.testing.assert_allclose(whole @ whole.T, np.eye(35), atol=1e-13)
    np.testing.assert_allclose(standing["J"] - standing["J"] @ K.T @ K, 0.0, atol=1e-13)
    still = ~standing["J"].any(axis=0)
    assert still.sum() == 17
    assert (np.sort(Z[still], axis=1)[:, -1] == 1.0).all() and (np.count_nonzero(Z[still], axis=1) == 1).all()


def test_the_qp_within_contacts_and_base_is_that_of_all_velocities_and_impulses(standing):
    """Against the same problem with orthonormal columns, all rows written out; to 1e-9."""
    rng, X, start = np.random.default_rng(5), standing["X"], standing["start"]
    (d, size), (n, k) = X.shape, standing["Z"].shape
    own, far, binding = make_orthonormal(X, n, k), np.full(size, np.inf), 0
    for _ in range(20):
        target = start + X @ rng.normal(scale=0.1, size=size)
        A, J, half = rng.normal(size=(9, n)), rng.normal(size=(4, n)), rng.normal(size=(5, d))
        G = np.concatenate((np.stack((half, -half), axis=1).reshape(10, d), rng.normal(size=(6, d))))
        b, g = J @ target[:n] + rng.normal(size=4), G @ start - 0.3
        lower, upper = start[:n] - 0.3, start[:n] + 0.3
        lower[rng.integers(n)] = upper[rng.integers(n)] = np.inf
        lower[lower == np.inf] = -np.inf
        x, is_solved = project_within(A, 1e-3, target, X, start, k, J, b, G, g, 10, lower, upper)
        AX, JX, GX, V = A @ own[:n], J @ own[:n], G @ own, own[:n]
        rows = np.vstack((JX, GX, V, -V))
        rhs = np.concatenate((b - J @ start[:n], g - G @ start, lower - start[:n], start[:n] - upper))
        finite, y = np.isfinite(rhs), own.T @ (target - start)
        ours = np.ascontiguousarray(rows[finite]), rhs[finite]
        assert is_solved == minimize(AX.T @ AX + 1e-3 * np.eye(size), y, *ours, -far, far, np.zeros(finite.sum()))
        if is_solved:
            np.testing.assert_allclose(x, start + own @ y, atol=1e-9)
            binding += np.abs(rows @ y - rhs)[finite].min() < 1e-9
    assert binding > 5


def test_standing_dynamics_are_those_of_the_least_forces(standing):
    M, h, Z, n = standing["M"], standing["h"], standing["Z"], len(standing["h"])
    D, torque = np.empty((n, n)), np.empty(n)
    standing_dynamics(M, h, standing["Jp"], standing["Y"], split_space(standing["J"])[0], D, torque)
    w = np.random.default_rng(2).normal(size=Z.shape[1])
    a = Z @ w
    f = np.linalg.pinv(standing["Jp"][:, :6].T) @ (M @ a + h)[:6]
    np.testing.assert_allclose((D @ a + torque)[6:], (M @ a + h - standing["Jp"].T @ f)[6:], atol=1e-9)
    np.testing.assert_allclose(D @ (np.eye(n) - Z @ Z.T), 0.0, atol=1e-10)
    assert not D[:6].any() and not torque[:6].any()


def test_cones_hold_what_friction_does():
    """Against the round cone, in which the pyramid lies, and touches it in four edges."""
    rng, mu = np.random.default_rng(3), 0.6
    normal = np.array([0.2, -0.1, 0.97]) / np.linalg.norm([0.2, -0.1, 0.97])
    rows, rhs = np.empty((6, 5)), np.empty(6)
    cone_rows(normal[None], np.array([mu]), np.array([2.0]), np.array([300.0]), DT, SCALE, 2, rows, rhs)
    assert not rows[:, :2].any()
    inside = touching = 0
    for _ in range(3000):
        f = normal * rng.uniform(-50.0, 400.0) + rng.normal(scale=50.0, size=3)
        along = f @ normal
        share = np.linalg.norm(f - along * normal) / along
        meets = (rows[:, 2:] @ (SCALE * DT * f) >= rhs - 1e-12).all()
        assert not meets or (2.0 - 1e-6 <= along <= 300.0 + 1e-6 and share <= mu + 1e-9)
        assert meets or not (2.0 <= along <= 300.0 and share <= mu / np.sqrt(2.0))
        inside, touching = inside + meets, touching + (meets and share > 0.9 * mu)
    assert inside > 200 and touching > 2


def test_points_in_a_line_carry_no_wrench(standing):
    Jp, Z = standing["Jp"][:6].copy(), standing["Z"]
    n, k = Z.shape
    out = np.empty((n + 6, k)), np.empty(n + 6), np.empty((6, 6)), np.empty((6, 0))
    assert not eliminate_base(standing["M"], standing["h"], standing["v"], DT, Jp, Z, standing["rest"], SCALE, *out)
