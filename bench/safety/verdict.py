"""Verdicts on contacts: an evasion that keeps clear proves that one was avoidable; a linear program, that it was not.

**The criterion.** The robot is taken back to the last control step at which the pair in contact was farther apart than
the influence distance d2 (to the start, if there is none): before that, the controller could not know. From there it
evades, within the joints' limits, and with no task but to keep everything as far away as it can: it stands still, or
takes in every period the velocity of a linear program, with several horizons, and a bias to one side or another. Bodies
in contact already at that time do not count.

- An evasion without contact, until half a second after the contact in question: the contact is **avoidable**.
- The distance of the pair does not depend on any joint: unavoidable, `fixed`.
- Every evasion ends in contact, and in the last period of the one that lasted longest no velocity within limits, held
  for a tenth of a second, keeps that pair apart, to first order: unavoidable, `outrun`.
- The same of all near pairs together: for each velocity there is one that it does not keep apart: `squeezed`.
- Every evasion ends in contact, and nothing is proved: `unproven`, which counts as avoidable.

All of it is computed in MuJoCo: distances, normals, Jacobians and motion. The solver under test has no part in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bench.safety.rollout import (
    INFLUENCE_DISTANCE,
    Evasion,
    JointLimits,
    Start,
    evade,
    joint_limits,
    largest,
    near_rows,
    policies,
)
from qpavoid import Log, ScenarioConfig
from qpavoid_bench.arena.checker import Contact, Findings
from qpavoid_bench.arena.mujoco_model import MujocoModel

AFTER = 0.5
"""Time after the contact in question for which evasions must stay clear [s]."""
RESOLUTION = 0.02
"""Resolution of the last avoidable moment [s]."""
PROOF_TIME = 0.1
"""Time after the last period of an evasion within which contact must be certain [s]."""


class LastAvoidable(NamedTuple):
    """The last moment from which one of the evasions still kept clear of a contact."""

    lead_time: float
    """Time from it to the contact [s]."""
    distance: float
    """Of the pair at that moment [m]."""
    status: int
    """Of the control step at that moment: index into `qpavoid.run.log.STATUSES`."""


@dataclass(frozen=True)
class Verdict:
    """Whether a contact was avoidable, with its proof."""

    contact: Contact
    why: str
    """`avoidable`, `unproven`, `fixed`, `outrun` or `squeezed`."""
    detail: str

    @property
    def avoidable(self) -> bool:
        """Whether it is not proved to be unavoidable."""
        return self.why in ("avoidable", "unproven")


def judge(twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings) -> tuple[Verdict, ...]:
    """Return verdicts on the contacts of a run in the order of time, up to the first that is avoidable."""
    verdicts: list[Verdict] = []
    excused = ~twin.movable
    for contact in findings.contacts:
        verdicts.append(_judge(twin, scenario, log, findings, contact, excused))
        if verdicts[-1].avoidable:
            break
        excused[contact.pair] |= verdicts[-1].why != "squeezed"  # a squeeze excuses none of its pairs alone
    return tuple(verdicts)


def _judge(
    twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings, contact: Contact, excused: Any
) -> Verdict:
    names = " - ".join(twin.scene.pair_names[contact.pair])
    if not twin.movable[contact.pair]:
        return Verdict(contact, "fixed", f"no joint changes the distance of {names}")
    limits, first = joint_limits(twin, scenario), _in_range(twin, scenario, log, findings, contact)
    before = log.v[first - 1] if first else np.zeros(len(limits.speed))
    start = Start(findings.q[first], before, float(log.t[first]), min(contact.time + AFTER, float(log.t[-1])))
    pairs = ~excused
    pairs[contact.pair] = True
    while True:
        evasions = []
        for policy in policies(len(limits.speed)):
            evasion = evade(twin, limits, start, scenario.dt, policy, pairs)
            if evasion.contact is None:
                proof = f"{policy.name} from t = {start.t:.3f} s on keeps {1e3 * evasion.clearance:.1f} mm"
                return Verdict(contact, "avoidable", proof)
            evasions.append(evasion)
        longest = max(evasions, key=lambda evasion: evasion.t)
        why, detail = certify(twin, limits, longest, pairs)
        if why != "outrun" or longest.contact == contact.pair:
            return Verdict(contact, why, detail)
        pairs[longest.contact] = False


def last_avoidable(
    twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings, verdict: Verdict
) -> LastAvoidable:
    """Return the last moment from which an evasion stays clear, by bisection between coming into range and contact.

    What counts are the pair in contact and all without a contact before it.
    """
    contact, limits = verdict.contact, joint_limits(twin, scenario)
    pairs = twin.movable.copy()
    pairs[[other.pair for other in findings.contacts if other.time < contact.time]] = False
    until = min(contact.time + AFTER, float(log.t[-1]))

    def clear(k: int) -> bool:
        start = Start(findings.q[k], log.v[k - 1] if k else np.zeros(len(limits.speed)), float(log.t[k]), until)
        evasions = (evade(twin, limits, start, scenario.dt, policy, pairs) for policy in policies(len(limits.speed)))
        return any(evasion.contact is None for evasion in evasions)

    low, high = _in_range(twin, scenario, log, findings, contact), int(np.searchsorted(log.t, contact.time)) - 1
    while high - low > max(1, round(RESOLUTION / scenario.dt)):
        middle = (low + high) // 2
        low, high = (middle, high) if clear(middle) else (low, middle)
    twin.place(findings.q[low], float(log.t[low]))
    return LastAvoidable(contact.time - float(log.t[low]), twin.distance(contact.pair), int(log.status[low]))


def _in_range(twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings, contact: Contact) -> int:
    """Return the last control step before a contact at which the pair was out of range; 0 if there is none."""
    max_distance = scenario.avoidance.d2 - scenario.avoidance.offset
    for k in range(int(np.searchsorted(log.t, contact.time)) - 1, 0, -1):
        twin.place(findings.q[k], float(log.t[k]))
        if twin.distance(contact.pair) > max_distance:
            return k
    return 0


def certify(twin: MujocoModel, limits: JointLimits, evasion: Evasion, pairs: Any) -> tuple[str, str]:
    """Return why an evasion among pairs (m,) had to end in contact, and the figures that prove it, if they do."""
    rows = near_rows(twin, evasion.q, evasion.t, pairs, INFLUENCE_DISTANCE)
    box, names = limits.box(evasion.q, evasion.v, PROOF_TIME), twin.scene.pair_names
    for i in np.flatnonzero(rows.pair == evasion.contact).tolist():
        retreat = float(np.maximum(rows.J[i] * box[0], rows.J[i] * box[1]).sum())
        if rows.d[i] + PROOF_TIME * (retreat + rows.feedforward[i]) < 0.0:
            speeds = f"closes at {-rows.feedforward[i]:.3f} m/s, the joints can retreat at {retreat:.3f}"
            return "outrun", f"{' - '.join(names[rows.pair[i]])} {speeds}"
    answer = largest(PROOF_TIME * rows.J, rows.d + PROOF_TIME * rows.feedforward, box, np.inf, None)
    if answer is not None and answer[-1] < 0.0:
        tight = rows.d + PROOF_TIME * (rows.J @ answer[:-1] + rows.feedforward) < answer[-1] + 1e-6
        between = ", ".join(" - ".join(names[pair]) for pair in rows.pair[tight])
        return (
            "squeezed",
            f"after {PROOF_TIME:g} s one of {between} is {-1e3 * answer[-1]:.1f} mm deep, whatever the joints do",
        )
    return "unproven", f"the longest evasion ends in contact at t = {evasion.t:.3f} s"
