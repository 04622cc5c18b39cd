"""What a control step is given, checked before anything is changed: times, configurations, velocities, poses.

What cannot be true is no exception: the robot stops, or an obstacle counts as not updated, with a `Reason`. The bounds
are wide of anything that a robot does, and narrow enough that no arithmetic of a step loses its meaning.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, hypot, inf, isfinite, log2, ulp
from typing import Any

import numpy as np

from qpavoid.errors import NumericalError
from qpavoid.kernels.obstacles import (
    EXACT,
    FAR,
    FARTHEST,
    FAST,
    FASTEST,
    LEFT_HANDED,
    NEARLY,
    NO_QUATERNION,
    NO_ROTATION,
    NOT_FINITE,
)
from qpavoid.problem import Array, as_vector, not_finite
from qpavoid.reason import Reason, ReasonKind, Severity

LARGEST_VELOCITY = 1e4
"""Norm of a measured joint velocity that no robot has, whatever its number of joints [rad/s, m/s]."""
LARGEST_COMMAND = 1e6
"""Norm of a velocity to `filter` that cannot be meant [rad/s, m/s]; far beyond all limits, which it is brought to."""
_BEYOND = 2.0 * np.pi
"""Farther than this beyond its limits nothing is that was measured in radians, or in metres [rad, m]."""
_RESOLUTION = 1e-3
"""Largest distance of a time to the next number, in control periods: seconds since 1970 are fine from 0.25 ms on,
milliseconds since 1970 are not."""
_OFF = 0.5
"""Part of a control period by which time may go on differently before it is said."""
_GAP = 10.0, 0.1
"""Control periods, and time [s], after both of which a robot does no longer move at what was commanded last."""

FAULTS = {
    NOT_FINITE: "NaN or infinity",
    FAR: f"farther away than {FARTHEST:g} m",
    FAST: f"faster than {FASTEST:g} m/s or rad/s",
    NO_ROTATION: "no rotation",
    LEFT_HANDED: "left-handed, no rotation",
    NO_QUATERNION: "quaternion not of length 1; give x y z w",
}
"""What `kernels.check_states` finds, in words."""


@dataclass(slots=True)
class Times:
    """Time of a step, as `Clock.read` takes it."""

    t: float
    """[s]."""
    shift: float = 0.0
    """By how much the clock was set back, as far as is known [s]; never positive."""
    resumed: bool = False
    """Whether the step begins anew: after a gap, or because the clock was set back."""
    periods: int = 1
    """Control periods since the last step."""
    faults: tuple[Reason, ...] = ()
    notes: tuple[Reason, ...] = ()


class Clock:
    """Time of the control steps: as given, or a control period later than the step before."""

    def __init__(self, dt: float) -> None:
        self._dt, self._now = dt, -inf
        self._gap = max(_GAP[0] * dt, _GAP[1])
        self._fine = 2.0 ** (52 + floor(log2(_RESOLUTION * dt)))  # below it, the resolution of a time is fine enough

    def usual(self, t: Any) -> float | None:
        """Return the time of the next step where that goes on as it should [s], None where there is more to see to."""
        expected = self._now + self._dt
        if t is None:
            return expected if expected > -inf else None
        is_usual = type(t) is float and abs(t - expected) <= _OFF * self._dt and abs(t) < self._fine
        return t if is_usual else None

    @property
    def is_first(self) -> bool:
        """Whether the next step is the first one."""
        return self._now == -inf

    def reset(self) -> None:
        """Let the next step be the first one."""
        self._now = -inf

    def set(self, t: float) -> None:
        """Take t [s] as the time of this step."""
        self._now = t

    def read(self, t: Any) -> Times:
        """Return the time of the next step; nothing is changed.

        Args:
            t: as given [s]; None for a control period after the last step.

        Raises:
            NumericalError: t is no number.
        """
        expected = self._now + self._dt if self._now > -inf else 0.0
        if t is None or self.usual(t) is not None:
            return Times(expected if t is None else t)
        t = as_time("t", t)
        if not ulp(t) <= _RESOLUTION * self._dt:  # neither for NaN and infinity
            rough = f"{t:g}: its resolution is coarser than {_RESOLUTION:g} control periods; is it in seconds?"
            detail = rough if isfinite(t) else f"{t}"
            return Times(expected, faults=(Reason.of(ReasonKind.IMPLAUSIBLE, "t", detail=detail),))
        off = t - expected
        if self._now == -inf or abs(off) <= _OFF * self._dt:
            return Times(t)
        step, severity = t - self._now, Severity.WARNING if off > 0.0 else Severity.INFO
        back = step < 0.0
        detail = "the clock was set back" if back else ""
        note = Reason.of(ReasonKind.TIMING, "t", amount=off, unit="s", severity=severity, detail=detail)
        periods = max(1, round(step / self._dt))
        return Times(t, off if back else 0.0, back or step > self._gap, periods, notes=(note,))


def as_time(name: str, t: Any) -> float:
    """Return a time as a float [s], infinite where it is too large for one.

    Raises:
        NumericalError: it is no number.
    """
    try:
        isfinite(t)  # unlike float(t), not of text
        return float(t)
    except OverflowError:
        return inf
    except (TypeError, ValueError):
        raise NumericalError(f"{name}: not a number: {t!r:.60}") from None


class Configurations:
    """Tell configurations of a robot that can be true from others, and normalise what is nearly of length 1."""

    def __init__(self, model: Any, q_index: Any = (), lower: Any = (), upper: Any = (), units: Any = ()) -> None:
        """Take over limits.

        Args:
            model: pinocchio model.
            q_index: index in q of each coordinate with position limits (nb,).
            lower: limits (nb,) [rad or m].
            upper: limits (nb,) [rad or m].
            units: rad or m of each of them.
        """
        self._shape, self._index, self._units = (model.nq,), np.asarray(q_index, dtype=np.intp), units
        self._lower, self._upper = np.asarray(lower) - _BEYOND, np.asarray(upper) + _BEYOND
        joints = list(model.joints)
        self._owners = [model.names[i] for i, joint in enumerate(joints) for _ in range(joint.nq)]
        self._names = [next(model.names[j.id] for j in joints if j.idx_q == k and j.nq) for k in self._index.tolist()]
        self._units_of_length_1 = _unit_parts(model)
        self.bounds = np.full((3, model.nq), FARTHEST)
        """(3, nq) least and largest value of each coordinate, and number of the part of length 1 it is in, or -1."""
        self.bounds[0], self.bounds[2] = -FARTHEST, -1.0
        self.bounds[0, self._index], self.bounds[1, self._index] = self._lower, self._upper
        for number, (part, _) in enumerate(self._units_of_length_1):
            self.bounds[2, part] = number
        least = np.minimum(-self._lower, self._upper)
        self._small = float(np.min(least, initial=FARTHEST))
        """Norm up to which no coordinate is beyond anything."""

    def read(self, name: str, q: Array) -> tuple[Array, tuple[Reason, ...], tuple[Reason, ...]]:
        """Return the configuration (nq,), with what is wrong with it and what was normalised.

        Args:
            name: of the argument.
            q: configuration (nq,).
        """
        size = hypot(*q.tolist())
        if size <= self._small and not self._units_of_length_1:
            return q, (), ()
        faults = () if size <= self._small else self._faults(name, q, size)
        notes: tuple[Reason, ...] = ()
        if not faults:
            for part, joint in self._units_of_length_1:
                length = hypot(*q[part].tolist())
                off = abs(length - 1.0)
                if off > NEARLY:
                    detail = f"of length {length:.4g}, expected 1"
                    return q, (Reason.of(ReasonKind.IMPLAUSIBLE, name, joint, detail=detail),), ()
                if off > EXACT:
                    q = q.copy()
                    q[part] /= length
                    notes += (Reason.of(ReasonKind.NORMALISED, name, joint, amount=off, unit="-"),)
        return q, faults, notes

    def require(self, name: str, value: Any) -> Array:
        """Return a configuration (nq,) that can be true.

        Raises:
            NumericalError: wrong shape, no numbers, or numbers that cannot be true.
        """
        q, faults, _ = self.read(name, as_vector(name, value, self._shape))
        if faults:
            raise NumericalError(str(faults[0]))
        return q

    def _faults(self, name: str, q: Array, size: float) -> tuple[Reason, ...]:
        if not size < inf:
            return (Reason.of(ReasonKind.IMPLAUSIBLE, name, detail=not_finite(q)),)
        here = q[self._index]
        beyond = np.maximum(here - self._upper, self._lower - here)
        reasons = [
            Reason.of(
                ReasonKind.IMPLAUSIBLE, name, self._names[i], amount=float(beyond[i]) + _BEYOND, unit=self._units[i],
                detail="beyond its limits; is it in degrees?" if self._units[i] == "rad" else "beyond its limits",
            )
            for i in np.flatnonzero(beyond > 0.0).tolist()
        ]  # fmt: skip
        far = np.flatnonzero(np.abs(q) > FARTHEST).tolist() if not reasons else []
        return (*reasons, *[Reason.of(ReasonKind.IMPLAUSIBLE, name, self._owners[k], detail="too large") for k in far])


def _unit_parts(model: Any) -> list[tuple[slice, str]]:
    """List which parts of q have length 1: quaternions, and cosine and sine of an angle; and whose they are."""
    parts = []
    for joint, name in zip(list(model.joints), list(model.names), strict=True):
        start, kind = joint.idx_q, (joint.nq, joint.nv)
        if kind == (7, 6):
            parts.append((slice(start + 3, start + 7), name))
        elif kind == (4, 3) and joint.shortname() == "JointModelPlanar":
            parts.append((slice(start + 2, start + 4), name))
        elif kind in ((4, 3), (2, 1)):
            parts.append((slice(start, start + kind[0]), name))
    return parts


def check_velocity(name: str, v: Array, largest: float) -> tuple[Reason, ...]:
    """Say what is wrong with a velocity (nv,) whose norm is to be at most `largest` [rad/s, m/s]; nothing if it is."""
    if hypot(*v.tolist()) <= largest:
        return ()
    return (Reason.of(ReasonKind.IMPLAUSIBLE, name, detail=not_finite(v)),)
