"""Frames that rest on the ground: rows J v = 0 that are never relaxed.

They are solved before anything else: with an orthonormal basis Z of the velocities that move no contact, v = rest + Z w
for any w, and all tasks, rows and bounds become ones of w. So they come before tracking, avoidance and acceleration
limits; hard joint limits are kept as well, and where those leave no velocity that holds the contacts, the robot stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from qpavoid import config
from qpavoid.control.tasks.base import frame_pose
from qpavoid.errors import ConfigError
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, Contacts

_CORRECTION = 0.02
"""Largest speed at which what has slid is put right [m/s, rad/s]."""
_DEPENDENT = 1e-8
"""Share of the largest pivot below which a row follows from the others, as with two hands on one wall [-]."""


class ContactRows:
    """The contacts of a robot, and where they rest."""

    def __init__(
        self, settings: Sequence[config.Contact], frame_ids: Sequence[int], kinematics: ForwardKinematics
    ) -> None:
        """Let the frames rest where the kinematics have them; see `build_contacts`."""
        self.frame_ids = tuple(frame_ids)
        self._anchors = [tuple(part.copy() for part in frame_pose(kinematics, i)) for i in frame_ids]
        self._gains = np.repeat([contact.gain for contact in settings], 6)
        self._rows = np.repeat([(True, contact.type == "surface") for contact in settings], 3)

    def update(self, kinematics: ForwardKinematics) -> Contacts:
        """Their rows at the configuration for which the kinematics are up to date, solved."""
        J = np.concatenate([kinematics.frame_jacobian(i) for i in self.frame_ids])
        missing = []
        for frame_id, (position, rotation) in zip(self.frame_ids, self._anchors, strict=True):
            x, R = frame_pose(kinematics, frame_id)
            missing += [*(position - x), *rotation_vector((rotation @ R.T).tolist())]
        b = (self._gains * missing)[self._rows]
        b *= min(1.0, _CORRECTION / max(float(np.abs(b).max()), 1e-12))
        return solve_contacts(J[self._rows], b)


def build_contacts(
    configs: Sequence[config.Contact], robot: Robot, q0: Array, source: Path = Path("contacts")
) -> ContactRows | None:
    """Make the contacts of a scenario, resting where their frames are at q0; None where there are none.

    Args:
        configs: the scenario's `contacts`.
        robot: the robot that is controlled.
        q0: configuration (nq,) at which they rest.
        source: scenario file, named in errors.

    Raises:
        UnknownName: of a frame.
        ConfigError: the robot cannot move.
    """
    if not configs:
        return None
    ids = [robot.frame_id(c.frame, f"{source}: contacts.{index}.frame") for index, c in enumerate(configs)]
    kinematics = ForwardKinematics(robot.model, ids)
    kinematics.compute(q0)
    rows = ContactRows(configs, ids, kinematics)
    if not rows.update(kinematics).Z.shape[1]:
        raise ConfigError(f"{source}: contacts leave {robot.name} no way to move; leave some out, or make them points")
    return rows


def solve_contacts(J: Array, b: Array) -> Contacts:
    """Solve J v = b by a QR factorisation of Jᵀ with pivoting; rows that follow from others are left out.

    Args:
        J: (c, nv) contact Jacobian.
        b: (c,) what has to be put right [m/s, rad/s].
    """
    from scipy.linalg.lapack import dgeqp3, dorgqr, dtrtrs  # scipy is slow to import, and few robots have contacts

    c, nv = J.shape
    packed, order, tau, _, _ = dgeqp3(J.T)
    pivots = np.abs(packed.diagonal())
    rank = int((pivots > _DEPENDENT * pivots[0]).sum())
    Q = np.zeros((nv, nv), order="F")
    Q[:, : min(c, nv)] = packed[:, :nv]
    Q, _, _ = dorgqr(Q, tau)
    v_particular = np.zeros(nv)
    if b.any():
        y, _ = dtrtrs(packed[:rank, :rank], b[order[:rank] - 1], trans=1)
        v_particular = Q[:, :rank] @ y
    return Contacts(np.ascontiguousarray(Q[:, rank:]), v_particular, J, b)
