"""Frames that rest on the ground: rows J v = 0 that are never relaxed.

They are solved before anything else: with an orthonormal basis Z of the velocities that move no contact, v = rest + Z w
for any w, and all tasks, rows and bounds become ones of w. So they come before tracking, avoidance and acceleration
limits; hard joint limits are kept as well, and where those leave no velocity that holds the contacts, the robot stops.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np

from qpavoid import config, kernels
from qpavoid.errors import ConfigError, require_known
from qpavoid.model.kinematics import ForwardKinematics, columns, support_masks
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, Contacts, Mask
from qpavoid.reason import Reason, ReasonKind

_NO_BACKUP = Reason.of(
    ReasonKind.NO_BACKUP, "contacts", detail="backup trajectories do not hold contacts: avoidance.backup"
)
"""Assumption where obstacles move and the robot stands on something."""


def within_contacts(
    avoidance: config.Avoidance, has_contacts: bool, has_torques: bool
) -> tuple[config.Avoidance, tuple[Reason, ...]]:
    """Return the block as far as it goes with contacts, and what to assume where obstacles move.

    Backup trajectories do not hold contacts. At the torque level, the stop that the look-ahead counts on is one of
    accelerations that all joints could have at once whatever the rest does: a tenth of those that one has.
    """
    if not has_contacts:
        return avoidance, ()
    reasons = (_NO_BACKUP,) if avoidance.backup else ()
    look_ahead = avoidance.look_ahead and not has_torques
    return avoidance.model_copy(update={"backup": False, "look_ahead": look_ahead}), reasons


class ContactRows:
    """The contacts of a robot, where they rest, and which of them do now."""

    def __init__(
        self, settings: Sequence[config.Contact], frame_ids: Sequence[int], model: Any, kinematics: ForwardKinematics
    ) -> None:
        """Let the frames rest where the kinematics have them; see `build_contacts`."""
        self.settings, self.frame_ids = tuple(settings), tuple(frame_ids)
        self.anchors = kinematics.frame_poses[list(frame_ids)]
        """(f, 12) where each rests: rotation by columns, then position [m]."""
        self.gains = np.array([contact.gain for contact in settings])
        """(f,) feedback on what has slid [1/s]."""
        self.surfaces: Mask = np.array([contact.type == "surface" for contact in settings])
        """(f,) whether it may not turn, either."""
        self.shares = np.ones(len(frame_ids))
        """How far each bears what it may [-]: 1 at rest on the ground, 0 off it, between where it comes or leaves."""
        self.leaves: Mask = np.zeros(len(frame_ids), dtype=bool)
        """(f,) whether each is about to leave."""
        self.columns = columns(model)
        """(e,) see `model.kinematics.columns`."""
        self.support = support_masks(model)[[model.frames[i].parentJoint for i in frame_ids]]
        """(f, e) 1 of the columns that move each frame, else 0."""
        self.jacobians = np.zeros((len(frame_ids), 6, model.nv))
        """(f, 6, nv) of the frames, in the last step; zero of those that were not active."""
        self._rates = np.zeros(len(frame_ids))
        self._comes = np.zeros(len(frame_ids), dtype=bool)

    def own_copy(self) -> ContactRows:
        """Return the same contacts, which come and leave by themselves."""
        own = copy(self)
        for name in ("anchors", "shares", "leaves", "jacobians", "_rates", "_comes"):
            setattr(own, name, getattr(self, name).copy())
        return own

    def take_over(self, other: ContactRows) -> None:
        """Let contacts rest, come and leave as other ones of the same frames do."""
        self.anchors[:], self.shares[:] = other.anchors, other.shares
        self._rates[:], self._comes[:], self.leaves[:] = other._rates, other._comes, other.leaves

    def switch(self, names: Collection[str], duration: float) -> None:
        """Let the contacts of some frames come or stay, and all others leave, over a duration [s].

        Raises:
            UnknownName: of a frame without a contact.
        """
        frames = [contact.frame for contact in self.settings]
        for name in names:
            require_known(name, frames, "set_contacts: no contact of")
        for i, frame in enumerate(frames):
            aim, self.leaves[i] = float(frame in names), frame not in names
            self._comes[i] |= bool(aim and self.shares[i] == 0.0)
            self._rates[i] = np.sign(aim - self.shares[i]) / max(duration, 1e-9)

    def advance(self, dt: float, kinematics: ForwardKinematics) -> None:
        """Go on by a control period dt [s]; a frame that comes rests where the kinematics have it."""
        if not self._rates.any():
            return
        for i in np.flatnonzero(self._comes):
            self.anchors[i] = kinematics.frame_poses[self.frame_ids[i]]
        self._comes[:] = False
        np.clip(self.shares + dt * self._rates, 0.0, 1.0, out=self.shares)

    def update(self, kinematics: ForwardKinematics) -> Contacts:
        """Their rows at the configuration for which the kinematics are up to date, solved."""
        ids = np.array(self.frame_ids, dtype=np.intp)
        J, b, _ = kernels.contact_rows(
            kinematics.J, self.columns, self.support, kinematics.frame_poses, ids, self.anchors, self.gains,
            self.surfaces, self.shares, self.jacobians,
        )  # fmt: skip
        return solve_contacts(J, b)


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
    rows = ContactRows(configs, ids, robot.model, kinematics)
    if not rows.update(kinematics).Z.shape[1]:
        raise ConfigError(f"{source}: contacts leave {robot.name} no way to move; leave some out, or make them points")
    return rows


def solve_contacts(J: Array, b: Array) -> Contacts:
    """Solve J v = b; rows that follow from others are left out.

    Args:
        J: (c, nv) contact Jacobian.
        b: (c,) what has to be put right [m/s, rad/s].
    """
    return Contacts(*kernels.solve_rows(J, b), J, b)
