"""Could a contact have been avoided? Flights that keep clear prove that it could; a linear program, that it could not.

**The criterion.** The robot is taken back to the last tick at which the pair that touched was farther apart than the
influence distance d2 (to the start, if there is none): before that, the controller could not know. From there it flees,
within the joints' limits, and with no task but to keep everything as far away as it can: it stands still, or takes at
every step the velocity of a linear program, with several horizons, and leaning to one side or another. Bodies that
touch already at that time are left out.

- A flight without contact, until half a second after the contact in question: the contact is **avoidable**.
- The distance of the pair does not depend on any joint: unavoidable, `fixed`.
- Every flight ends in contact, and at the last step of the one that lasted longest no velocity within limits, held for
  a tenth of a second, keeps the touching pair apart, to first order: unavoidable, `outrun`.
- The same of all near pairs together: for each velocity there is one that it does not keep apart: `squeezed`.
- Every flight ends in contact, and nothing is proved: `unproven`, which counts as avoidable.

All of it is computed in MuJoCo: distances, normals, Jacobians and motion. Nothing is asked of the solver under test.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bench.safety.flight import REACH, Flight, Means, Start, fly, joint_means, largest, manners, near_rows
from qpavoid import Log, ScenarioConfig
from qpavoid.arena.checker import Contact, Findings
from qpavoid.arena.mujoco_model import MujocoModel

AFTER = 0.5
"""Flights must stay clear for so long after the contact in question [s]."""
RESOLUTION = 0.02
"""To which the last way out is sought [s]."""
AHEAD = 0.1
"""What is to be unavoidable must be so within that time after the last step of a flight [s]."""


class LastWayOut(NamedTuple):
    """The last moment at which one of the flights still kept clear of a contact that could have been avoided."""

    before: float
    """How long before the contact that was [s]."""
    apart: float
    """How far apart the pair was then [m]."""
    status: int
    """How the tick ended that let it pass: index into `qpavoid.run.log.STATUSES`."""


@dataclass(frozen=True)
class Verdict:
    """Whether a contact could have been avoided, and how that is known."""

    contact: Contact
    why: str
    """`avoidable`, `unproven`, `fixed`, `outrun` or `squeezed`."""
    detail: str

    @property
    def avoidable(self) -> bool:
        """What is not proved to be unavoidable counts as avoidable."""
        return self.why in ("avoidable", "unproven")


def judge(twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings) -> tuple[Verdict, ...]:
    """Verdicts on the contacts of a run in the order of time, up to the first that is avoidable."""
    verdicts: list[Verdict] = []
    excused = ~twin.movable
    for contact in findings.contacts:
        verdicts.append(_judge(twin, scenario, log, findings, contact, excused))
        if verdicts[-1].avoidable:
            break
        excused[contact.pair] |= verdicts[-1].why != "squeezed"  # a squeeze is one matter, with all who take part
    return tuple(verdicts)


def _judge(
    twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings, contact: Contact, excused: Any
) -> Verdict:
    names = " - ".join(twin.scene.pair_names[contact.pair])
    if not twin.movable[contact.pair]:
        return Verdict(contact, "fixed", f"no joint changes the distance of {names}")
    means, first = joint_means(twin, scenario), _in_range(twin, scenario, log, findings, contact)
    before = log.v[first - 1] if first else np.zeros(len(means.speed))
    start = Start(findings.q[first], before, float(log.t[first]), min(contact.time + AFTER, float(log.t[-1])))
    watched = ~excused
    watched[contact.pair] = True
    while True:
        flights = []
        for manner in manners(len(means.speed)):
            flight = fly(twin, means, start, scenario.dt, manner, watched)
            if flight.touched is None:
                how = f"{manner.name} from t = {start.t:.3f} s on keeps {1e3 * flight.clearance:.1f} mm"
                return Verdict(contact, "avoidable", how)
            flights.append(flight)
        last = max(flights, key=lambda flight: flight.t)
        why, detail = certify(twin, means, last, watched)
        if why != "outrun" or last.touched == contact.pair:
            return Verdict(contact, why, detail)
        watched[last.touched] = False


def last_way_out(
    twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings, verdict: Verdict
) -> LastWayOut:
    """When it was too late for every flight, by bisection between coming into range and the contact.

    Flights watch the pair that touched and all that had not touched before it.
    """
    contact, means = verdict.contact, joint_means(twin, scenario)
    watched = twin.movable.copy()
    watched[[other.pair for other in findings.contacts if other.time < contact.time]] = False
    until = min(contact.time + AFTER, float(log.t[-1]))

    def clear(k: int) -> bool:
        start = Start(findings.q[k], log.v[k - 1] if k else np.zeros(len(means.speed)), float(log.t[k]), until)
        flights = (fly(twin, means, start, scenario.dt, manner, watched) for manner in manners(len(means.speed)))
        return any(flight.touched is None for flight in flights)

    low, high = _in_range(twin, scenario, log, findings, contact), int(np.searchsorted(log.t, contact.time)) - 1
    while high - low > max(1, round(RESOLUTION / scenario.dt)):
        middle = (low + high) // 2
        low, high = (middle, high) if clear(middle) else (low, middle)
    twin.place(findings.q[low], float(log.t[low]))
    return LastWayOut(contact.time - float(log.t[low]), twin.distance(contact.pair), int(log.status[low]))


def _in_range(twin: MujocoModel, scenario: ScenarioConfig, log: Log, findings: Findings, contact: Contact) -> int:
    """The last tick before a contact at which the pair was out of range; 0 if there is none."""
    reach = scenario.avoidance.d2 - scenario.avoidance.offset
    for k in range(int(np.searchsorted(log.t, contact.time)) - 1, 0, -1):
        twin.place(findings.q[k], float(log.t[k]))
        if twin.distance(contact.pair) > reach:
            return k
    return 0


def certify(twin: MujocoModel, means: Means, flight: Flight, watched: Any) -> tuple[str, str]:
    """Why a flight among the watched pairs (m,) had to end in contact, and the figures that prove it, if they do."""
    rows = near_rows(twin, flight.q, flight.t, watched, REACH)
    box, names = means.box(flight.q, flight.v, AHEAD), twin.scene.pair_names
    for i in np.flatnonzero(rows.pair == flight.touched).tolist():
        retreat = float(np.maximum(rows.J[i] * box[0], rows.J[i] * box[1]).sum())
        if rows.d[i] + AHEAD * (retreat + rows.drift[i]) < 0.0:
            speeds = f"closes at {-rows.drift[i]:.3f} m/s, the joints can retreat at {retreat:.3f}"
            return "outrun", f"{' - '.join(names[rows.pair[i]])} {speeds}"
    answer = largest(AHEAD * rows.J, rows.d + AHEAD * rows.drift, box, np.inf, None)
    if answer is not None and answer[-1] < 0.0:
        tight = rows.d + AHEAD * (rows.J @ answer[:-1] + rows.drift) < answer[-1] + 1e-6
        between = ", ".join(" - ".join(names[pair]) for pair in rows.pair[tight])
        return (
            "squeezed",
            f"after {AHEAD:g} s one of {between} is {-1e3 * answer[-1]:.1f} mm deep, whatever the joints do",
        )
    return "unproven", f"the flight that lasts longest touches at t = {flight.t:.3f} s"
