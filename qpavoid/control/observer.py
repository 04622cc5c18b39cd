"""What acts on a robot from outside, by its momentum: torques that its own dynamics do not explain.

De Luca and Mattone 2003, "Actuator failure detection and isolation using generalized momenta"; De Luca et al. 2006,
"Collision detection and safe reaction with the DLR-III lightweight manipulator arm".
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.dynamics import mirrored
from qpavoid.problem import Array
from qpavoid.reason import Reason, ReasonKind, Severity


class MomentumObserver:
    """r' = K (ṗ - τ - Cᵀv + g - r) of the momentum p = M v, without forming ṗ: r = K (p - p₀ - ∫ (τ + Cᵀv - g + r)).

    So r follows the torque from outside, and what the model does not know of friction and masses, as a low-pass of the
    rate K. What the latter amount to is learnt joint by joint from motion without contact; what is beyond comes from
    outside.
    """

    def __init__(self, model: Any, settings: config.Observer, names: tuple[str, ...], units: tuple[str, ...]) -> None:
        """Begin with thresholds that are not known.

        Args:
            model: pinocchio model of a robot whose base is fixed, with the armature that counts.
            settings: block of the scenario.
            names: of the nv coordinates.
            units: their units, rad or m.
        """
        self._model, self._data, self._settings = model, model.createData(), settings
        self._names, self._units = names, tuple("Nm" if unit == "rad" else "N" for unit in units)
        self.residual = np.zeros(model.nv)
        """(nv,) torque from outside, as observed [Nm or N]."""
        self.threshold = np.array([settings.threshold.get(name, np.inf) for name in names])
        """(nv,) residual beyond which a joint is touched; infinite where it is not known [Nm or N]."""
        self._largest: Array | None = None
        self.is_touched = False
        """Whether a residual has been beyond its threshold since the last `reset`."""
        self.stops = settings.stop
        """Whether a robot that is touched brakes, and rests until `reset`."""
        self.reset()

    def reset(self) -> None:
        """Forget momentum and residual; thresholds stay."""
        self._p_start: Array | None = None
        self._integral, self._bias = np.zeros_like(self.residual), np.zeros_like(self.residual)
        self.residual[:], self.is_touched = 0.0, False

    def learn(self) -> None:
        """Learn thresholds from now on until `finish_learning`, while nothing touches the robot."""
        self._largest = np.zeros_like(self.residual)

    def finish_learning(self) -> Array:
        """Take `margin` times the largest residual since `learn` as the threshold of each joint; return them (nv,)."""
        if self._largest is not None:
            self.threshold, self._largest = self._settings.margin * self._largest, None
        return np.array(self.threshold)

    def update(self, q: Array, v: Array, torque: Array, dt: float) -> tuple[Reason, ...]:
        """Take a measured state, and the torques that have led to it.

        Args:
            q: configuration (nq,).
            v: velocity (nv,).
            torque: (nv,) from the state before to this one [Nm or N].
            dt: time since the state before [s].

        Returns:
            A reason for each joint that is touched, not while thresholds are learnt.
        """
        model, data, gain = self._model, self._data, self._settings.rate
        p = mirrored(pin.crba(model, data, q)) @ v
        bias = pin.computeCoriolisMatrix(model, data, q, v).T @ v - pin.computeGeneralizedGravity(model, data, q)
        if self._p_start is None:
            self._p_start, self._bias = p, bias
            return ()
        self._integral += dt * (torque + 0.5 * (self._bias + bias))
        r = gain / (1.0 + gain * dt) * (p - self._p_start - self._integral)
        self._integral += dt * r
        self.residual[:], self._bias = r, bias
        if self._largest is not None:
            np.maximum(self._largest, np.abs(r), out=self._largest)
            return ()
        touched = np.flatnonzero(np.abs(r) > self.threshold).tolist()
        self.is_touched |= bool(touched)
        severity = Severity.ALARM if self._settings.stop else Severity.WARNING
        return tuple(
            Reason.of(
                ReasonKind.TOUCHED, self._names[j], amount=float(r[j]), unit=self._units[j], severity=severity
            )
            for j in touched
        )  # fmt: skip
