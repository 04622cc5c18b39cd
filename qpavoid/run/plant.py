"""A robot in MuJoCo whose joints have position servos: what a controller meets outside of exact simulations."""

from __future__ import annotations

import numpy as np

from qpavoid.model.scene import Scene
from qpavoid.problem import Array
from qpavoid.run.mujoco import build, mujoco

_STEP = 1e-3
"""Largest time step of the dynamics [s]: servos of 10 ms are resolved."""


class Plant:
    """Dynamics of a robot under position servos, which follow setpoints late; no gravity, no contacts.

    Each servo is a spring and a damper between joint and setpoint, of gains that its own inertia at the start makes
    critically damped, with a lag behind a moving setpoint of damping over stiffness. The other joints' motions disturb
    it, and inertias change with the configuration, so that the lag is never quite what it was meant to be.
    """

    def __init__(self, scene: Scene, q0: Array, lag: float) -> None:
        """Begin at rest.

        Args:
            scene: robot and obstacles.
            q0: configuration (nq,).
            lag: time by which a joint follows its setpoint late [s].

        Raises:
            ValueError: see `build`.
        """
        self.scene = build(scene, q0, has_servos=True)
        """The model, with distances of its own."""
        self.t = 0.0
        """Time [s]."""
        model, data = self.scene.model, self.scene.data
        model.opt.gravity[:], model.opt.integrator = 0.0, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        mujoco.mj_forward(model, data)
        inertia, column = np.empty(model.nv), np.empty(model.nv)
        for i, unit in enumerate(np.eye(model.nv)):
            mujoco.mj_mulM(model, data, column, unit)
            inertia[i] = column[i]
        stiffness = inertia[self.scene.v_index] * (2.0 / lag) ** 2
        model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = stiffness, -stiffness
        model.actuator_biasprm[:, 2] = -lag * stiffness
        self._setpoint = np.array(q0)
        self._pairs = np.flatnonzero(scene.obstacle_of[scene.pairs[:, 1]] >= 0).tolist()

    @property
    def q(self) -> Array:
        """(nq,) configuration."""
        return np.array(self.scene.data.qpos[self.scene.q_index])

    @property
    def v(self) -> Array:
        """(nv,) velocity."""
        return np.array(self.scene.data.qvel[self.scene.v_index])

    def follow(self, v: Array, dt: float) -> float:
        """Move the setpoints at v (nv,) for dt [s]; return the least distance to any obstacle meanwhile [m]."""
        scene, count, least = self.scene, int(np.ceil(dt / _STEP - 1e-9)), np.inf
        scene.model.opt.timestep = dt / count
        for _ in range(count):
            scene.data.ctrl[:] = self._setpoint
            mujoco.mj_step(scene.model, scene.data)
            self._setpoint += v * (dt / count)
            self.t += dt / count
            scene.place(scene.data.qpos[scene.q_index], self.t)
            least = min(least, min(map(scene.distance, self._pairs), default=np.inf))
        return float(least)
