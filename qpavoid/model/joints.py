"""Joints of a model: their limits, configurations from joint names, and models in which some are locked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config import JointLimits
from qpavoid.errors import ConfigError, matching, require_known
from qpavoid.model.kinematics import MIMIC, turning_columns
from qpavoid.model.limits import JointBounds
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.pairs import pair_array
from qpavoid.problem import Array, IntArray, Mask

_NO_LIMIT = 1e9
"""Speed [rad/s or m/s] or position [rad or m] from which a limit means that there is none, as files write it."""
_MIMIC_TOLERANCE = 1e-6
"""Difference of a joint's value from the one that its mimic relation gives, up to which they agree [rad or m]."""


def frame_index(model: Any, name: str) -> int:
    """Return the index of an existing frame.

    Where a joint has the same name, it is that of the link.
    """
    return int(model.getFrameId(name, pin.BODY) if model.existFrame(name, pin.BODY) else model.getFrameId(name))


def joint_bounds(model: Any) -> JointBounds:
    """Read the joint limits of a model, in tangent space; a URDF has none of accelerations and jerks.

    Only joints with one coordinate in q and v have position limits. A velocity limit of 0, and a range from 0 to 0,
    mean that the URDF gives none; see `joints_fixed_by_limits` of ranges that are meant, `assume_speeds` of velocities.
    """
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    lower[lower <= -_NO_LIMIT], upper[upper >= _NO_LIMIT] = -np.inf, np.inf
    single = np.array([(j.idx_q, j.idx_v) for j in model.joints[1:] if j.nq == j.nv == 1], dtype=np.intp).reshape(-1, 2)
    low, high = lower[single[:, 0]], upper[single[:, 0]]
    limited = (np.isfinite(low) | np.isfinite(high)) & (low < high)
    velocity = np.array(model.velocityLimit)
    return JointBounds(
        velocity=np.where(_is_speed(velocity), velocity, np.inf),
        q_index=single[limited, 0],
        v_index=single[limited, 1],
        lower=low[limited],
        upper=high[limited],
        acceleration=np.full(model.nv, np.inf),
        jerk=np.full(model.nv, np.inf),
    )


def _is_speed(velocity: Array) -> Mask:
    """Return which velocity limits are ones."""
    return np.asarray((velocity > 0.0) & (velocity < _NO_LIMIT))


def limits_by_joint(model: Any, limits: JointLimits, path: Path) -> JointLimits:
    """Replace patterns in the limits of a robot.yaml by the joints that they match, but for those that follow others.

    Raises:
        UnknownName: a name or a pattern without a joint.
    """
    joints = dict(zip(list(model.names)[1:], list(model.joints)[1:], strict=True))
    free = [name for name, joint in joints.items() if joint.shortname() != MIMIC]
    expanded = {}
    for kind in JointLimits.model_fields:
        given = getattr(limits, kind)
        patterns = {pattern: value for pattern, value in given.items() if pattern not in joints}
        expanded[kind] = {
            name: value
            for pattern, value in patterns.items()
            for name in matching([pattern], free, f"{path}: limits.{kind}: no joint")
        }
        expanded[kind] |= {name: value for name, value in given.items() if name in joints}
    return limits.model_copy(update=expanded)


def set_limits(model: Any, limits: JointLimits, path: Path) -> None:
    """Set the position and velocity limits that a robot.yaml gives.

    Raises:
        ConfigError, UnknownName: of a joint that mimics another one, has no position limits, or is unknown.
    """
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    velocity = np.array(model.velocityLimit)
    for kind in JointLimits.model_fields:
        for name in getattr(limits, kind):
            if find_joint(model, name, f"{path}: limits.{kind}").shortname() == MIMIC:
                raise ConfigError(f"{path}: limits.{kind}: {_follows(model, name)}; limit that one")
    for name, (low, high) in limits.position.items():
        joint = find_joint(model, name, f"{path}: limits.position")
        if joint.nq != 1:
            raise ConfigError(f"{path}: limits.position: joint {name!r} is continuous; leave it out")
        lower[joint.idx_q], upper[joint.idx_q] = low, high
    for name, speed in limits.velocity.items():
        joint = find_joint(model, name, f"{path}: limits.velocity")
        if isinstance(speed, list) and len(speed) != joint.nv:
            raise ConfigError(
                f"{path}: limits.velocity: joint {name!r}: {len(speed)} values for {joint.nv} coordinates"
            )
        velocity[joint.idx_v : joint.idx_v + joint.nv] = speed
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
    _set_speeds(model, velocity)


def _set_speeds(model: Any, velocity: Array) -> None:
    """Set the largest speeds (nv,), which are those of both directions in a URDF."""
    model.velocityLimit, model.lowerVelocityLimit = velocity, -velocity


ASSUMED_SPEED = 1.0
"""Largest speed of a coordinate for which none is given [rad/s or m/s], as in MoveIt's time parameterisation."""


def assume_speeds(model: Any, notes: list[Note]) -> None:
    """Give a largest speed to every coordinate of a model without one, and name the joints in the notes.

    Bases that float or roll have none, nor have joints of which the file says 0.
    """
    velocity = np.array(model.velocityLimit)
    has_limit, turns = _is_speed(velocity), turning_columns(model)
    names: dict[str, list[str]] = {}
    for name, joint in zip(model.names[1:], model.joints[1:], strict=True):
        part = slice(joint.idx_v, joint.idx_v + joint.nv)
        if joint.shortname() != MIMIC and not has_limit[part].all():
            kinds = set(turns[joint.idx_vExtended : joint.idx_vExtended + joint.nv].tolist())
            units = ["rad/s" if turning else "m/s" for turning in sorted(kinds)]
            names.setdefault(" and ".join(f"{ASSUMED_SPEED:g} {unit}" for unit in units), []).append(name)
    velocity[~has_limit] = ASSUMED_SPEED
    _set_speeds(model, velocity)
    for speed, joints in names.items():
        clause = f"no velocity limit is given: {speed} {'is' if ' and ' not in speed else 'are'} assumed"
        notes.append(Note(NoteKind.LIMIT, tuple(joints), clause, "give it under `limits.velocity`", "warning"))


def find_joint(model: Any, name: str, where: str) -> Any:
    """Return the joint of a name.

    Raises:
        UnknownName: there is none; with the nearest one.
    """
    require_known(name, list(model.names)[1:], f"{where}: no joint")
    return model.joints[model.getJointId(name)]


def hinge_or_slide(model: Any, index: int) -> tuple[bool, Array]:
    """Return True for a slide, False for a hinge, and the joint's axis (3,) in its own frame.

    Raises:
        ValueError: it is neither a hinge nor a slide.
    """
    joint = model.joints[index]
    if joint.nq != 1 or joint.nv != 1:
        raise ValueError(f"joint {model.names[index]!r}: {joint.shortname()} is neither a hinge nor a slide")
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    screw = np.asarray(data.joints[index].S).ravel()
    return (True, screw[:3]) if np.any(screw[:3]) else (False, screw[3:])


def middle_configuration(model: Any) -> Array:
    """Return the neutral configuration (nq,), moved into the joint limits.

    A bounded joint whose range leaves 0 out stands at the middle of its range.
    """
    q = pin.neutral(model)
    for joint in model.joints[1:]:
        lower, upper = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        if joint.nq == 1 and not lower <= q[joint.idx_q] <= upper:
            q[joint.idx_q] = 0.5 * (lower + upper)
    return np.asarray(q)


def set_joints(model: Any, q: Array, values: Mapping[str, float], where: str) -> Array:
    """Return the configuration q (nq,) with other values of some joints, by name [rad or m].

    Raises:
        ConfigError, UnknownName: a joint with more than one angle, one that mimics another and is not where that takes
            it, or an unknown one.
    """
    q = q.copy()
    mimics = [name for name in values if find_joint(model, name, where).shortname() == MIMIC]
    for name, value in values.items():
        joint = model.joints[model.getJointId(name)]
        if name in mimics:
            continue
        if joint.nq == 1:
            q[joint.idx_q] = value
        elif joint.nq == 2 and joint.nv == 1:
            q[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
        else:
            raise ConfigError(f"{where}: joint {name!r} has {joint.nq} coordinates; give q0 as a list of all of q")
    for name in mimics:
        joint = model.joints[model.getJointId(name)]
        expected = joint.extract().scaling * q[joint.idx_q] + joint.extract().offset
        if abs(values[name] - expected) > _MIMIC_TOLERANCE:
            raise ConfigError(
                f"{where}: {_follows(model, name)}, to {expected:g} and not {values[name]:g}; leave it out"
            )
    return q


def _follows(model: Any, name: str) -> str:
    mimicking, mimicked = list(model.mimicking_joints), list(model.mimicked_joints)
    leader = mimicked[mimicking.index(model.getJointId(name))]
    return f"joint {name!r} follows {model.names[leader]!r} (mimic)"


def remove_joints(
    model: Any, bodies: Any, joint_names: Sequence[str], q: Array, where: str
) -> tuple[Any, Any, IntArray]:
    """Fix some joints where q has them: the smaller model, its bodies, and the indices in q that remain."""
    ids = [find_joint(model, name, where).id for name in joint_names]
    for joint, leader in zip(list(model.mimicking_joints), list(model.mimicked_joints), strict=True):
        if leader in ids and joint not in ids:
            ids.append(joint)
        elif joint in ids and leader not in ids:
            raise ConfigError(f"{where}: {_follows(model, model.names[joint])}; lock that one")
    coordinates_left = [range(joint.idx_q, joint.idx_q + joint.nq) for joint in model.joints[1:] if joint.id not in ids]
    index = np.array([i for coordinates in coordinates_left for i in coordinates], dtype=np.intp)
    model, bodies = pin.buildReducedModel(model, bodies, ids, q)
    joints = [body.parentJoint for body in bodies.geometryObjects]
    for a, b in pair_array(bodies).tolist():
        if joints[a] == joints[b]:
            bodies.removeCollisionPair(pin.CollisionPair(a, b))
    return model, bodies, index
