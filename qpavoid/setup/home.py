"""A home pose to start from: within the limits, clear of collision, able to move its tools in every direction."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.model.joints import frame_index
from qpavoid.model.kinematics import columns, support_masks
from qpavoid.model.robot import Robot
from qpavoid.model.space import Space
from qpavoid.problem import Array, Mask
from qpavoid.setup.sampling import SEED, PairDistances, draw_poses

HOME_CLEARANCE = 4.0 / 3.0
"""Distance of a pair at home, in units of its safety distance: 40 mm where 30 mm are to be kept [-]."""
MIN_CONDITIONING = 0.5
"""Conditioning of a limb at home, in units of what it typically has, below which it counts as singular [-]."""
_DRAWS = 200
"""Random configurations for the typical conditioning, and trials to repair one fault."""
_MAX_TRIES = 3000
"""Trials of all repairs together: some seconds."""
_DIGITS = 2
"""Decimals of positions that were drawn [rad or m]."""
_CONTACT_FAULT = 10.0
"""Additional fault of a pair in collision: larger than all faults of pairs that are merely near [-]."""


class Conditioning(NamedTuple):
    """How well a limb can move its end in every direction."""

    value: float
    """Smallest singular value of its Jacobian: of all six rows from six joints on, else of the three of the position;
    directions that it can never move in are left out [m/rad or 1]."""
    typical: float
    """Median of the same over random configurations."""

    @property
    def ratio(self) -> float:
        """Value in units of what is typical [-]."""
        return self.value / self.typical

    def __str__(self) -> str:
        """Return one clause for people."""
        return f"smallest singular value {self.value:.3f}, {self.ratio:.1f} times the typical one"


class Limbs:
    """Conditioning of the limbs that end at some frames."""

    def __init__(self, robot: Robot, frames: Sequence[str], seed: int = SEED) -> None:
        """Find the directions that each limb moves in, and its typical conditioning; leave out frames that rest."""
        self._model, self._data = robot.model, robot.model.createData()
        self._masks, self._columns = support_masks(robot.model), columns(robot.model)
        self.columns: dict[str, Mask] = {}
        """End of each limb: which coordinates (nv,) move it relative to the root."""
        self._limbs: dict[str, tuple[int, int, int, float]] = {}  # frame, rows, rank, typical value
        draws, moving = draw_poses(robot, _DRAWS, seed), Space(robot.model, robot.bounds()).moving
        for name in filter(robot.model.existFrame, frames):
            frame = frame_index(robot.model, name)
            moved = np.any([self._jacobian(frame, q) != 0.0 for q in draws[:5]], axis=(0, 1)) & moving
            rows = 6 if moved.sum() >= 6 else 3
            values = np.median([self._values(frame, rows, moved, q) for q in draws], axis=0)
            rank = int(np.sum(values > 1e-6 * max(values.max(initial=0.0), 1e-9)))
            if rank:
                self.columns[name], self._limbs[name] = moved, (frame, rows, rank, float(values[rank - 1]))

    def at(self, q: Array) -> dict[str, Conditioning]:
        """Compute the conditioning of each limb, by its end, in a configuration (nq,)."""
        return {
            name: Conditioning(float(self._values(frame, rows, self.columns[name], q)[rank - 1]), typical)
            for name, (frame, rows, rank, typical) in self._limbs.items()
        }

    def _jacobian(self, frame: int, q: Array) -> Array:
        """Compute the Jacobian (6, nv) of a frame's origin; columns of joints that mimic others are added to theirs."""
        pin.computeJointJacobians(self._model, self._data, q)
        pose = pin.updateFramePlacement(self._model, self._data, frame)
        J = self._data.J.reshape(6, -1, order="F") * self._masks[self._model.frames[frame].parentJoint]
        J[:3] += np.cross(J[3:], pose.translation, axisa=0, axisc=0)
        folded = np.zeros((6, self._model.nv))
        np.add.at(folded.T, self._columns, J.T)
        return folded

    def _values(self, frame: int, rows: int, moved: Mask, q: Array) -> Array:
        return np.asarray(np.linalg.svd(self._jacobian(frame, q)[:rows, moved], compute_uv=False))


@dataclass(frozen=True)
class Home:
    """A home pose, its clearance and its conditioning."""

    q: Array
    """(nq,)."""
    clearance: float
    """Least distance of any pair [m]; infinite where there are none."""
    nearest: tuple[str, str] | None
    """Bodies of that pair."""
    deficit: float
    """Largest distance that a pair lacks to `HOME_CLEARANCE` times its safety distance [m]; 0 where none lacks any."""
    conditioning: dict[str, Conditioning]
    """Of the limb that ends at each frame."""
    preference: int | None
    """Index of the preferred pose that it is; None: a pose near the first of them."""

    @property
    def singular(self) -> list[str]:
        """Frames that cannot be moved well in every direction."""
        return [name for name, value in self.conditioning.items() if value.ratio < MIN_CONDITIONING]


class _PoseCriteria:
    """Faults of a pose: of its m pairs, then of its limbs, each 0 or more."""

    def __init__(self, robot: Robot, frames: Sequence[str], d1: Array) -> None:
        self.distances, self.limbs = PairDistances(robot), Limbs(robot, frames)
        self.need = HOME_CLEARANCE * d1

    def faults(self, q: Array) -> Array:
        """Compute what each pair (m,) lacks of its distance, then each limb of its conditioning, as shares [-]."""
        deficit = np.maximum(1.0 - self.distances.all(q) / self.need, 0.0) if len(self.need) else np.zeros(0)
        deficit += _CONTACT_FAULT * (deficit > 1.0)
        limbs = [max(1.0 - limb.ratio / MIN_CONDITIONING, 0.0) for limb in self.limbs.at(q).values()]
        return np.concatenate((deficit, limbs))

    def movers(self, fault: int) -> Mask:
        """Return the coordinates (nv,) that can mend a fault."""
        pairs = len(self.need)
        return self.distances.moved_by(fault) if fault < pairs else list(self.limbs.columns.values())[fault - pairs]

    def home(self, q: Array, preference: int | None) -> Home:
        """Describe a pose as a home."""
        d, nearest = self.distances.all(q), None
        if len(d):
            a, b = self.distances.pairs[int(np.argmin(d))]
            nearest = self.distances.names[a], self.distances.names[b]
        deficit = float(np.max(self.need - d, initial=0.0))
        return Home(q, float(np.min(d, initial=np.inf)), nearest, deficit, self.limbs.at(q), preference)


def find_home(
    robot: Robot,
    preferences: Iterable[Array],
    frames: Sequence[str],
    d1: Array,
    pinned: Iterable[str] = (),
    seed: int = SEED,
) -> Home:
    """Find a pose near a preferred one with clear pairs and no singular limb.

    The first preferred pose without a fault is taken. Where all have one, the worst fault of the best is mended by
    moving the joints that it depends on, little by little, then the next; in the end every joint that need not have
    moved is restored. Where not all can be mended, the pose with the fewest and smallest faults is taken.

    Args:
        robot: with its pairs.
        preferences: configurations, the best first; at least one.
        frames: ends of limbs that should move in every direction.
        d1: safety distance of each pair (m,) [m].
        pinned: joints that stay where the first preferred pose has them.
        seed: of the draw.
    """
    criteria, poses = _PoseCriteria(robot, frames, d1), [np.asarray(q) for q in preferences]
    is_pinned = np.array([name.partition(".")[0] in set(pinned) for name in robot.coordinate_names], dtype=bool)
    faults = [float(criteria.faults(q).sum()) for q in (poses[:1] if is_pinned.any() else poses)]
    if 0.0 in faults:
        best = faults.index(0.0)
        return criteria.home(poses[best], best)
    best = int(np.argmin(np.floor(np.array(faults) / _CONTACT_FAULT)))
    q = _repair(robot, criteria, poses[best], ~is_pinned, seed)
    return criteria.home(q, best if np.array_equal(q, poses[best]) else None)


def _repair(robot: Robot, criteria: _PoseCriteria, start: Array, free: Mask, seed: int) -> Array:
    """Find a pose near `start` with fewer faults; only free coordinates (nv,) differ."""
    space, model = Space(robot.model, robot.bounds()), robot.model

    def rounded(q: Array, part: float = 1.0) -> Array:
        """Return the pose on the way from the start to q, with few digits."""
        return space.move(start, np.round(part * np.asarray(pin.difference(model, start, q)), _DIGITS))

    random, q, evaluations, faults = np.random.default_rng(seed), start, 0, criteria.faults(start)
    is_unfixable = np.zeros(len(faults), dtype=bool)
    while evaluations < _MAX_TRIES and np.any(faults[~is_unfixable] > 0.0):
        worst = int(np.argmax(np.where(is_unfixable, -1.0, faults)))
        mask, best_pose = criteria.movers(worst) & free & space.moving, q
        for i, target in enumerate(space.draw(random, _DRAWS if mask.any() else 0)):
            step = (i + 1) / _DRAWS * np.asarray(pin.difference(model, q, target))
            candidate = rounded(space.move(q, step * mask))
            candidate_faults, evaluations = criteria.faults(candidate), evaluations + 1
            if candidate_faults.sum() < faults.sum() - 1e-9:
                best_pose, faults = candidate, candidate_faults
                if faults[worst] == 0.0:
                    break
        is_unfixable[worst] = best_pose is q
        q = best_pose
    total = criteria.faults(q).sum()
    nearer = (rounded(q, part) for part in np.linspace(0.05, 0.95, 19))
    q = next((candidate for candidate in nearer if criteria.faults(candidate).sum() <= total), q)
    total = criteria.faults(q).sum()
    for joint in list(model.joints)[1:]:  # whose move was not needed after all
        part = slice(joint.idx_q, joint.idx_q + joint.nq)
        candidate = q.copy()
        candidate[part] = start[part]
        if not np.array_equal(candidate, q) and criteria.faults(candidate).sum() <= total:
            q = candidate
    return q
