"""Common parts of the adapters; like these, they run in the library's environment, which has numpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np


class Adapter:
    """A library, set up for one scene: its control step, and what it sees.

    `step` alone is what `bench tick` times; `configuration`, `targets` and `velocity` translate before and after it.
    """

    def __init__(self, setup: SimpleNamespace) -> None:
        """Take a scene, as `qpavoid_bench.libraries.setup.describe` has it."""
        self.setup = setup

    def use_indices(
        self, neutral: Any, q_of: Callable[[str], int], v_of: Callable[[str], int], base: Any = range(7)
    ) -> None:
        """Store where joints, by their names, and a floating base stand in the library's configuration and velocity."""
        self._neutral = np.array(neutral, dtype=np.float64)
        self._q_index, self._v_index = np.zeros(self.setup.nq, dtype=int), np.zeros(self.setup.nv, dtype=int)
        if self.setup.floating:
            self._q_index[:7], self._v_index[:6] = list(base), range(6)
        for name, q_index, v_index in self.setup.joints:
            self._q_index[q_index], self._v_index[v_index] = q_of(name), v_of(name)

    def configuration(self, q: Any) -> Any:
        """Return a configuration (nq,) in the library's order."""
        out = self._neutral.copy()
        out[self._q_index] = q
        return out

    def targets(self, poses: Any) -> Any:
        """Return poses of the frames (f, 4, 4) as the library wants them."""
        return list(poses)

    def velocity(self, v: Any) -> Any:
        """Return a velocity of the library as (nv,)."""
        return np.asarray(v)[self._v_index]

    def move(self, placements: Mapping[int, Any]) -> None:
        """Put obstacles, by the numbers of their bodies, to poses (4, 4)."""
        raise NotImplementedError("it has no interface for obstacles that move")

    def step(self, q: Any, targets: Any) -> Any:
        """Compute the velocity of a control step."""
        raise NotImplementedError

    def frames(self, q: Any) -> Any:
        """Return the poses of the frames (f, 4, 4) by the library."""
        raise NotImplementedError

    def distances(self, q: Any) -> Any:
        """Return the distances of the pairs (m,) by the library [m]; NaN where it does not tell."""
        return np.full(len(self.setup.pairs), np.nan)


def urdf_with_bodies(setup: SimpleNamespace, bodies: Any) -> str:
    """Return the URDF with some bodies, each a link of its own: `body 3` is the link `body_3` with geometry `body_3_0`.

    Capsules are cylinders that Pinocchio is made to take for capsules.

    Raises:
        ValueError: a shape that URDF does not know.
    """
    elements = []
    for number in bodies:
        name, link, kind, size, placement = setup.bodies[number][:5]
        match kind:
            case "Sphere":
                shape = f'<sphere radius="{size[0]!r}"/>'
            case "Capsule" | "Cylinder":
                shape = f'<cylinder radius="{size[0]!r}" length="{size[1]!r}"/>'
            case "Box":
                shape = f'<box size="{size[0]!r} {size[1]!r} {size[2]!r}"/>'
            case _:
                raise ValueError(f"{name}: a {kind} cannot be given to it")
        capsule = f'<collision_checking><capsule name="body_{number}"/></collision_checking>' * (kind == "Capsule")
        elements.append(
            f'<link name="body_{number}"><collision name="body_{number}"><geometry>{shape}</geometry></collision>'
            f'{capsule}</link><joint name="to_body_{number}" type="fixed"><parent link="{link}"/>'
            f'<child link="body_{number}"/>{origin(placement)}</joint>'
        )
    return str(setup.urdf).replace("</robot>", "".join(elements) + "</robot>")


def origin(placement: Any) -> str:
    """Return the URDF element of a pose (4, 4)."""
    R = placement[:3, :3]
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    if np.hypot(R[0, 0], R[1, 0]) > 1e-9:
        roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    else:  # roll and yaw turn about the same axis
        roll, yaw = np.arctan2(-R[1, 2], R[1, 1]), 0.0
    return f'<origin xyz="{_numbers(placement[:3, 3])}" rpy="{_numbers((roll, pitch, yaw))}"/>'


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
