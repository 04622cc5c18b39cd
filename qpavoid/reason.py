"""Reasons: what a control step relaxed, assumed or could not do, as data; `str` makes a line of it for people."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Any, NamedTuple


class Severity(IntEnum):
    """Weight of a reason for a supervisor."""

    INFO = 1
    """Noise or an estimate: no margin was used."""
    WARNING = 2
    """A margin was used: a distance, a limit, a task."""
    ALARM = 3
    """Contact is predicted, or the robot is stopped."""


class ReasonKind(str, Enum):
    """Kind of event, with the `subject` and `amount` of its `Reason`."""

    ROW_RELAXED = "ROW_RELAXED"
    """An avoidance row is violated: the pair, its slack [m/s]."""
    BELOW_SAFETY_DISTANCE = "BELOW_SAFETY_DISTANCE"
    """A pair of a relaxed row is too near: the pair, what is missing to the safety distance [m]."""
    PREDICTED_TOO_NEAR = "PREDICTED_TOO_NEAR"
    """The look-ahead found no velocity whose braking trajectory stays clear: the pair, what is missing to the safety
    distance [m]; an alarm where any pair is predicted in contact, else a warning."""
    UNKNOWN_DISTANCE = "UNKNOWN_DISTANCE"
    """A distance is not a number: the pair."""
    ACCELERATION_RELAXED = "ACCELERATION_RELAXED"
    """A joint passes its acceleration limit: the joint, the excess of its velocity [rad/s or m/s]."""
    JERK_RELAXED = "JERK_RELAXED"
    """A joint passes its jerk limit, or its acceleration and jerk limits: the joint, the excess of its velocity
    [rad/s or m/s]."""
    LIMIT_RECOVERY = "LIMIT_RECOVERY"
    """A joint is outside its position limits and returns: the joint, the excess [rad or m], negative below."""
    AT_LOWER_LIMIT = "AT_LOWER_LIMIT"
    """A joint is kept from passing its lower position limit by a row or task: the joint, the bound on its velocity
    [rad/s or m/s]; of stalled tasks, its share of what holds them, as in STALLED [%]."""
    AT_UPPER_LIMIT = "AT_UPPER_LIMIT"
    """The same of its upper position limit."""
    AT_VELOCITY_LIMIT = "AT_VELOCITY_LIMIT"
    """A joint moves at its velocity limit where a row demands more: the joint, its velocity [rad/s or m/s]."""
    TOUCHED = "TOUCHED"
    """A torque from outside is beyond its threshold: the joint, that torque [Nm or N]; an alarm where it stops the
    robot."""
    AT_TORQUE_LIMIT = "AT_TORQUE_LIMIT"
    """A joint is at its torque limit where a row demands more: the joint, its torque [Nm or N]."""
    AT_FRICTION_LIMIT = "AT_FRICTION_LIMIT"
    """A force of a contact is at the edge of its friction cone, or at its least or greatest: the frame."""
    TORQUE_SATURATED = "TORQUE_SATURATED"
    """The torque of a velocity was cut at its limit, and another velocity follows from it: the joint, the excess
    [Nm or N]."""
    HOLDING_RELAXED = "HOLDING_RELAXED"
    """Gravity takes more of a joint's torque than it should, or soon will: the joint, by how much faster than its row
    allows, as a share of its limit [1/s]."""
    BALANCE_RELAXED = "BALANCE_RELAXED"
    """The capture point leaves what the robot stands on, or comes nearer to its edges than `support_margin`: by how
    much its row is violated [m/s]."""
    STALLED = "STALLED"
    """The tasks make no progress: a pair that holds them, its share of the forces that balance their pull on the joints
    [%], more than 10; no share of laws without rows, no pair where several hold them together."""
    OUT_OF_REACH = "OUT_OF_REACH"
    """A task makes no progress, and nothing is in the way: no nearer from here; the task, its error [m or rad]."""
    SINGULAR = "SINGULAR"
    """The same in a singularity, from which there is a way on: the task, its error [m or rad]."""
    BACKUP = "BACKUP"
    """The backup trajectory replaces the tasks: from their velocity, none would stay clear of moving obstacles."""
    NO_BACKUP = "NO_BACKUP"
    """No backup trajectory is looked for: what excludes it."""
    PLAN = "PLAN"
    """Of logs: a plan is followed in place of the tasks alone; `detail` says since when, and why."""
    NO_PLAN = "NO_PLAN"
    """Nothing is forecast or planned, or not all that is wanted: what excludes it; `detail` says why."""
    BUDGET_SPENT = "BUDGET_SPENT"
    """The robot brakes, or follows its backup trajectory, as the budget of the control step was spent: before what."""
    STALE = "STALE"
    """An obstacle was not updated in time: the obstacle, the age of its last update [s]."""
    NEVER_UPDATED = "NEVER_UPDATED"
    """An external obstacle has not been given yet: the obstacle, the time since the start [s]."""
    ESTIMATED = "ESTIMATED"
    """A twist was estimated from the poses of an obstacle: the obstacle."""
    IGNORED = "IGNORED"
    """An update was not used: its subject."""
    POINTS_DROPPED = "POINTS_DROPPED"
    """Points of a cloud were not used: the cloud, their number [-]."""
    IMPLAUSIBLE = "IMPLAUSIBLE"
    """An argument is implausible: its name."""
    NORMALISED = "NORMALISED"
    """A matrix or quaternion that is nearly a rotation is normalised: its subject, its deviation [-]."""
    TIMING = "TIMING"
    """Time did not advance by the control period: `t`, the difference [s]."""
    SOLVER_FAILED = "SOLVER_FAILED"
    """The solver gave no usable velocity; `detail` has its own words."""
    CONTACTS_INFEASIBLE = "CONTACTS_INFEASIBLE"
    """No velocity within the joint limits meets the contacts: `contacts`."""
    PRIORITY_UNSOLVED = "PRIORITY_UNSOLVED"
    """No back end could solve the QP of a priority level: the level."""
    START_TOO_NEAR = "START_TOO_NEAR"
    """A path would begin in contact: the pair, its distance [m]."""
    GOAL_TOO_NEAR = "GOAL_TOO_NEAR"
    """No goal of a path is clear: the pair that is nearest at the first of them, its distance [m]; no pair where goals
    follow from targets."""
    NOT_ATTAINED = "NOT_ATTAINED"
    """No configuration that attains the targets of a path was found."""
    NO_PATH = "NO_PATH"
    """No path was found within its budget: configurations that were checked [-]."""

    @property
    def severity(self) -> Severity:
        """Return the severity of a reason of this kind that has none of its own."""
        return _SEVERITIES.get(self, Severity.WARNING)


_SEVERITIES = {
    **dict.fromkeys(
        ("NO_BACKUP", "PLAN", "NO_PLAN", "ESTIMATED", "IGNORED", "POINTS_DROPPED", "NORMALISED", "TIMING"),
        Severity.INFO,
    ),
    **dict.fromkeys(
        (
            "PREDICTED_TOO_NEAR",
            "UNKNOWN_DISTANCE",
            "BUDGET_SPENT",
            "IMPLAUSIBLE",
            "SOLVER_FAILED",
            "CONTACTS_INFEASIBLE",
        ),
        Severity.ALARM,
    ),
}  # fmt: skip
_TEXTS: dict[str, str] = {
    "ROW_RELAXED": "row relaxed by",
    "BELOW_SAFETY_DISTANCE": "below the safety distance by",
    "PREDICTED_TOO_NEAR": "predicted below the safety distance by",
    "UNKNOWN_DISTANCE": "distance is not a number",
    "ACCELERATION_RELAXED": "acceleration limit passed by",
    "JERK_RELAXED": "jerk limit passed by",
    "LIMIT_RECOVERY": "outside its position limits by",
    "AT_LOWER_LIMIT": "at its lower limit, velocity bound",
    "AT_UPPER_LIMIT": "at its upper limit, velocity bound",
    "AT_VELOCITY_LIMIT": "at its velocity limit,",
    "TOUCHED": "is touched by",
    "AT_TORQUE_LIMIT": "at its torque limit,",
    "AT_FRICTION_LIMIT": "a force of the contact is at the limit of its cone",
    "TORQUE_SATURATED": "torque limit cuts",
    "HOLDING_RELAXED": "gravity takes too much of its torque, row relaxed by",
    "BALANCE_RELAXED": "balance row relaxed by",
    "STALLED": "no progress",
    "OUT_OF_REACH": "out of reach by",
    "SINGULAR": "in a singularity, short of its target by",
    "BACKUP": "backup trajectory instead of the tasks",
    "NO_BACKUP": "no backup trajectory",
    "PLAN": "plan followed",
    "NO_PLAN": "no plan",
    "BUDGET_SPENT": "left out, as the budget of the control step is spent",
    "STALE": "not updated for",
    "NEVER_UPDATED": "external, not given yet after",
    "ESTIMATED": "twist estimated from its poses",
    "IGNORED": "update not used",
    "POINTS_DROPPED": "points dropped:",
    "IMPLAUSIBLE": "implausible",
    "NORMALISED": "normalised, off by",
    "TIMING": "differs from the control period:",
    "SOLVER_FAILED": "no usable velocity",
    "CONTACTS_INFEASIBLE": "joint limits leave no velocity that holds them",
    "PRIORITY_UNSOLVED": "no back end could solve its QP",
    "START_TOO_NEAR": "a path would begin in contact, distance",
    "GOAL_TOO_NEAR": "no goal of the path is clear",
    "NOT_ATTAINED": "no configuration attains the targets",
    "NO_PATH": "no path was found, checked configurations:",
}


class Reason(NamedTuple):
    """One thing that a control step relaxed, assumed or could not do."""

    kind: ReasonKind
    """Kind of event; see there for its subject and amount."""
    subject: tuple[str, ...] = ()
    """Names: the bodies of a pair, a joint, a task, an obstacle, an argument."""
    amount: float | None = None
    """Amount in `unit`, where the kind has one."""
    unit: str = ""
    """Unit of `amount`: m, m/s, rad, rad/s, s, 1/s, Nm, N, % or - ."""
    severity: Severity = Severity.WARNING
    """Weight for a supervisor: that of the kind, unless the step knows better."""
    detail: str = ""
    """More for people, not for programs."""

    @classmethod
    def of(
        cls,
        kind: ReasonKind,
        *subject: str,
        amount: float | None = None,
        unit: str = "",
        severity: Severity | None = None,
        detail: str = "",
    ) -> Reason:
        """Make a reason with the severity of its kind unless another one is given; see the fields."""
        return cls(kind, subject, amount, unit, kind.severity if severity is None else severity, detail)

    def __str__(self) -> str:
        """Return one line for people: subject, kind, amount, detail."""
        parts = [_TEXTS[self.kind.value]]
        if self.unit == "%":
            parts = [f"{parts[0].partition(',')[0]}, {self.amount:.0f} % of what holds the tasks"]
        elif self.amount is not None:
            parts.append(_quantity(self.amount, self.unit))
        if self.detail:
            parts.append(f"({self.detail})")
        return f"{' - '.join(self.subject)}: {' '.join(parts)}" if self.subject else " ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON and logs, with the line for people as `text`."""
        return {
            "kind": self.kind.value,
            "subject": list(self.subject),
            "amount": self.amount,
            "unit": self.unit,
            "severity": self.severity.name,
            "text": str(self),
        }

    @property
    def key(self) -> tuple[str, tuple[str, ...]]:
        """Return kind and subject: of two steps, the same reason has the same key at any amount and severity."""
        return self.kind.value, self.subject


def _quantity(amount: float, unit: str) -> str:
    """Return an amount with its unit, lengths and speeds in mm."""
    if unit in ("m", "m/s"):
        return f"{1e3 * amount:.1f} m{unit}"
    if unit == "s":
        return f"{amount:.3f} s"
    return f"{amount:.4g}" if unit in ("", "-") else f"{amount:.4g} {unit}"
