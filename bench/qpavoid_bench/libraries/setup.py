"""A scene as plain data: what every library is given, whatever it is built on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import coal
import numpy as np

from qpavoid import Scene
from qpavoid.model.joints import hinge_or_slide
from qpavoid.model.limits import JointBounds
from qpavoid.problem import Array, IntArray
from qpavoid_bench.libraries.foreign.base import origin

_NO_LIMIT = 1e6
"""Value in the URDF of a limit that a joint does not have [rad, m or their rates]."""


def describe(
    scene: Scene,
    q: Array,
    frames: Sequence[tuple[int, float, float]],
    pairs: IntArray,
    dt: float,
    distances: tuple[float, float],
    bounds: JointBounds,
    damping: float = 0.0,
    options: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return a scene as the adapters take it, in plain data and numpy arrays; lengths in m, angles in rad.

    Args:
        scene: robot and obstacles.
        q: configuration at the start (nq,), in Pinocchio's order and conventions, as all configurations.
        frames: of tasks: their indices in the robot's model, and the weights of their positions and orientations.
        pairs: indices of bodies (m, 2).
        dt: control period [s].
        distances: safety and influence distance [m].
        bounds: limits of the joints.
        damping: weight of the velocity's square; 0: the library's default.
        options: of the library.

    Raises:
        ValueError: a joint that is neither a hinge nor a slide, or a shape that cannot be described.
    """
    model = scene.robot.model
    floating = model.njoints > 1 and model.joints[1].nv == 6
    links = ["world", *(f"link_{i}" for i in range(1, model.njoints))]
    described = [
        (f"frame_{i}", links[model.frames[f].parentJoint], np.array(model.frames[f].placement.homogeneous), *weights)
        for i, (f, *weights) in enumerate(frames)
    ]
    geometries, first = scene.geometry.geometryObjects, len(scene.body_names)
    bodies = [
        (
            f"body_{i}",
            links[body.parentJoint],
            *_shape(body.geometry),
            np.array(body.placement.homogeneous),
            i >= first and scene.obstacles[scene.obstacle_of[i]].moves,
        )
        for i, body in enumerate(geometries)
    ]
    return {
        "urdf": _urdf(model, bounds, links, described, floating),
        "floating": links[1] if floating else "",
        "links": links[1 if floating else 0 :],
        "joints": [
            (model.names[i], joint.idx_q, joint.idx_v)
            for i, joint in enumerate(model.joints)
            if i and not (floating and i == 1)
        ],
        "nq": model.nq,
        "nv": model.nv,
        "q": np.array(q),
        "speed": np.array(bounds.velocity),
        "acceleration": np.array(bounds.acceleration),
        "bodies": bodies,
        "robot_bodies": first,
        "pairs": np.asarray(pairs, dtype=int).reshape(-1, 2),
        "frames": described,
        "dt": dt,
        "d1": distances[0],
        "d2": distances[1],
        "damping": damping,
        "options": dict(options or {}),
    }


def _shape(shape: Any) -> tuple[str, Any]:
    """Return name and sizes of a shape, as coal's constructors take them; of a hull its points (n, 3).

    Raises:
        ValueError: there is no such description.
    """
    kind: str = type(shape).__name__
    match shape:
        case coal.Sphere():
            return kind, (shape.radius,)
        case coal.Capsule() if shape.halfLength == 0.0:
            return "Sphere", (shape.radius,)
        case coal.Capsule() | coal.Cylinder() | coal.Cone():
            return kind, (shape.radius, 2.0 * shape.halfLength)
        case coal.Box():
            return kind, tuple((2.0 * shape.halfSide).tolist())
        case coal.Ellipsoid():
            return kind, tuple(shape.radii.tolist())
        case coal.Halfspace():
            return kind, (np.array(shape.n), shape.d)
        case coal.ConvexBase():
            return "Convex", np.array(shape.points())
    raise ValueError(f"a {kind} cannot be given to other libraries")


def _urdf(model: Any, bounds: JointBounds, links: list[str], frames: list[Any], floating: bool) -> str:
    """Return joints, frames and limits as URDF: one link a joint, and one on a fixed joint a frame."""
    limits = np.clip(np.stack((bounds.lower, bounds.upper), axis=1), -_NO_LIMIT, _NO_LIMIT).tolist()
    ranges = dict(zip(bounds.q_index.tolist(), limits, strict=True))
    used = links[1 if floating else 0 :]
    elements = [f'<link name="{name}"/>' for name in (*used, *(frame[0] for frame in frames))]
    for index in range(2 if floating else 1, model.njoints):
        joint, (slides, axis) = model.joints[index], hinge_or_slide(model, index)
        low, high = ranges.get(joint.idx_q, (-_NO_LIMIT, _NO_LIMIT))
        speed = min(float(bounds.velocity[joint.idx_v]), _NO_LIMIT)
        elements.append(
            f'<joint name="{model.names[index]}" type="{"prismatic" if slides else "revolute"}">'
            f'<parent link="{links[model.parents[index]]}"/><child link="{links[index]}"/>'
            f"{origin(model.jointPlacements[index].homogeneous)}"
            f'<axis xyz="{" ".join(repr(float(value)) for value in axis)}"/>'
            f'<limit lower="{low!r}" upper="{high!r}" effort="1000.0" velocity="{speed!r}"/></joint>'
        )
    for name, link, placement, _, _ in frames:
        elements.append(
            f'<joint name="to_{name}" type="fixed"><parent link="{link}"/><child link="{name}"/>'
            f"{origin(placement)}</joint>"
        )
    return "\n".join(['<robot name="robot">', *elements, "</robot>"])
