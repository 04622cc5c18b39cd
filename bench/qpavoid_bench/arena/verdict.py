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

from typing import Any, NamedTuple

import numpy as np

from qpavoid import ScenarioConfig
from qpavoid.problem import Array
from qpavoid.run.mujoco import MujocoModel
from qpavoid_bench.arena.checker import Contact, Findings
from qpavoid_bench.arena.evasion import (
    INFLUENCE_DISTANCE,
    Evasion,
    JointLimits,
    Start,
    evade,
    largest,
    near_rows,
    policies,
)

AFTER = 0.5
"""Time after the contact in question for which evasions must stay clear [s]."""
PROOF_TIME = 0.1
"""Time after the last period of an evasion within which contact must be certain [s]."""


class Verdict(NamedTuple):
    """Whether a contact was avoidable, with its proof."""

    contact: Contact
    kind: str
    """`avoidable`, `unproven`, `fixed`, `outrun` or `squeezed`."""
    detail: str

    @property
    def avoidable(self) -> bool:
        """Return True if it is not proved to be unavoidable."""
        return self.kind in ("avoidable", "unproven")

    def describe(self, model: MujocoModel) -> str:
        """Return kind, pair, time and proof in a line."""
        pair = " - ".join(model.scene.pair_names[self.contact.pair])
        return f"{self.kind}: {pair} at {self.contact.time:.3f} s: {self.detail}"


def judge(model: MujocoModel, scenario: ScenarioConfig, t: Array, v: Array, findings: Findings) -> tuple[Verdict, ...]:
    """Return verdicts on the contacts of a run in the order of time, up to the first that is avoidable.

    Args:
        model: of the scenario.
        scenario: what was run.
        t: times of the control steps (N,) [s].
        v: velocities commanded at them (N, nv) [rad/s or m/s].
        findings: of the checker, on the same run.
    """
    verdicts: list[Verdict] = []
    excused = ~model.movable
    for contact in findings.contacts:
        verdicts.append(_judge(model, scenario, t, v, findings, contact, excused))
        if verdicts[-1].avoidable:
            break
        excused[contact.pair] |= verdicts[-1].kind != "squeezed"  # a squeeze excuses none of its pairs alone
    return tuple(verdicts)


def decisive(verdicts: tuple[Verdict, ...]) -> Verdict | None:
    """Return the verdict on the first contact that is avoidable, or else on the first; None without contact."""
    return next((verdict for verdict in verdicts if verdict.avoidable), verdicts[0] if verdicts else None)


def _judge(
    model: MujocoModel, scenario: ScenarioConfig, t: Array, v: Array, findings: Findings, contact: Contact, excused: Any
) -> Verdict:
    if not model.movable[contact.pair]:
        return Verdict(contact, "fixed", "no joint changes that distance")
    limits, first = JointLimits.of(model, scenario.limits), _in_range(model, scenario, t, findings, contact)
    v_before = v[first - 1] if first else np.zeros(len(limits.speed))
    start = Start(findings.q[first], v_before, float(t[first]), min(contact.time + AFTER, float(t[-1])))
    pairs = ~excused
    pairs[contact.pair] = True
    while True:
        evasions = []
        for policy in policies(len(limits.speed)):
            evasion = evade(model, limits, start, scenario.dt, policy, pairs)
            if evasion.contact is None:
                proof = f"{policy.name} from t = {start.t:.3f} s on keeps {1e3 * evasion.clearance:.1f} mm"
                return Verdict(contact, "avoidable", proof)
            evasions.append(evasion)
        longest = max(evasions, key=lambda evasion: evasion.t)
        kind, detail = _certify(model, limits, longest, pairs)
        if kind != "outrun" or longest.contact == contact.pair:
            return Verdict(contact, kind, detail)
        pairs[longest.contact] = False


def _in_range(model: MujocoModel, scenario: ScenarioConfig, t: Array, findings: Findings, contact: Contact) -> int:
    """Return the last control step before a contact at which the pair was out of range; 0 if there is none."""
    max_distance = scenario.avoidance.d2 - scenario.avoidance.offset
    for k in range(int(np.searchsorted(t, contact.time)) - 1, 0, -1):
        model.place(findings.q[k], float(t[k]))
        if model.distance(contact.pair) > max_distance:
            return k
    return 0


def _certify(model: MujocoModel, limits: JointLimits, evasion: Evasion, pairs: Any) -> tuple[str, str]:
    """Return why an evasion among pairs (m,) had to end in contact, and the figures that prove it, if they do."""
    rows = near_rows(model, evasion.q, evasion.t, pairs, INFLUENCE_DISTANCE)
    box, names = limits.box(evasion.q, evasion.v, PROOF_TIME), model.scene.pair_names
    for i in np.flatnonzero(rows.pair == evasion.contact).tolist():
        retreat = float(np.maximum(rows.J[i] * box[0], rows.J[i] * box[1]).sum())
        if rows.d[i] + PROOF_TIME * (retreat + rows.feedforward[i]) < 0.0:
            speeds = f"closes at {-rows.feedforward[i]:.3f} m/s, the joints can retreat at {retreat:.3f}"
            return "outrun", f"{' - '.join(names[rows.pair[i]])} {speeds}"
    answer = largest(PROOF_TIME * rows.J, rows.d + PROOF_TIME * rows.feedforward, box, np.inf, None)
    if answer is not None and answer[-1] < 0.0:
        tight = rows.d + PROOF_TIME * (rows.J @ answer[:-1] + rows.feedforward) < answer[-1] + 1e-6
        between = ", ".join(" - ".join(names[pair]) for pair in rows.pair[tight])
        depth = f"{-1e3 * answer[-1]:.1f} mm deep, whatever the joints do"
        return "squeezed", f"after {PROOF_TIME:g} s one of {between} is {depth}"
    return "unproven", f"the longest evasion ends in contact at t = {evasion.t:.3f} s"
