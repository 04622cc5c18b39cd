"""Distances of the pairs that are nearest to each body, and poses of all bodies, in many states.

No distance changes by more than its bodies travel, so most pairs need not be measured to tell which ones are nearest.
"""

from __future__ import annotations

import numpy as np

from qpavoid import kernels
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.controller import Controller
from qpavoid.kernels.near_pairs import candidate_pairs, measure_pairs
from qpavoid.kernels.recording import NearestPairs, RecordingCalls, measure_states
from qpavoid.kernels.structures import address
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.sample import POSE, STATE
from qpavoid.problem import IntArray


class StateMeasurement:
    """Measures states of a robot and its obstacles, which are written into its memory."""

    def __init__(self, controller: Controller, capacity: int) -> None:
        """Lay out memory for some states, with what is attached to the robot of a controller."""
        scene, model = controller.scene, controller.scene.robot.model
        self._kinematics, self._query = ForwardKinematics(model), controller.distances()
        self._query.set_influence_distance(np.inf)
        obstacles, pairs = len(scene.slots), len(scene.pairs)
        self._joints = np.array([body.parentJoint for body in scene.robot.bodies.geometryObjects], dtype=np.intp)
        self._numbers, self._margin = np.arange(obstacles), np.zeros(obstacles)
        self.q = np.zeros((capacity, model.nq))
        """(n, nq) configurations."""
        self.states = np.zeros((capacity, obstacles, STATE))
        """(n, o, 18) states of the obstacles."""
        self.distance = np.full((capacity, pairs + 1), np.inf)
        """(n, m + 1) distance of each pair, infinite of one that is not measured, and of none [m]."""
        self.posed = np.zeros((capacity, len(self._joints), POSE))
        """(n, b, 12) poses of the joints that move the bodies of the robot."""
        self._is_compiled = self._kinematics.is_compiled and self._query.is_compiled
        packed, states = self._query.packed, self.states[0]
        self._calls = RecordingCalls(
            place_obstacles=address(kernels.place_obstacles, packed, self._numbers, states, self._margin),
            update_kinematics=address(kernels.update_kinematics, self._kinematics.packed, self.q[0]),
            place_bodies=address(kernels.place_bodies, packed, self._kinematics.joint_poses),
            candidate_pairs=address(candidate_pairs, packed),
            measure_pairs=address(measure_pairs, packed, self._numbers),
        )
        self._nearest = NearestPairs(
            bodies=np.full((pairs, 2), -1),
            pair=np.full(len(self._joints), -1),
            distance=np.zeros(len(self._joints)),
            due=np.zeros(pairs, dtype=np.intp),
            is_due=np.zeros(pairs, dtype=bool),
        )

    def count_for(self, bodies: IntArray) -> None:
        """Let each pair count for two bodies of the robot from now on (m, 2); others are no bodies of it."""
        self._nearest.bodies[:] = np.where(bodies < len(self._joints), bodies, -1)
        self._nearest.pair.fill(-1)

    def measure(self, first: int, last: int) -> None:
        """Write poses, and distances of the nearest pairs at least, of states `first` to `last`, without that."""
        n, query = first, self._query
        while n < last:
            if self._is_compiled:
                n = measure_states(
                    self._calls, self._kinematics.packed, query.packed, self._nearest, self.q, self.states,
                    self._numbers, self._margin, self._joints, self.distance, self.posed, n, last,
                )  # fmt: skip
                if n == last:
                    return
            else:
                query.place(ObstacleStates(self._numbers, self.states[n], self._margin, {}))
                self._kinematics.compute(self.q[n])
            query.compute(self._kinematics.joint_poses, np.inf)
            self.distance[n, query.pairs] = query.arrays.results[query.pairs, 0]
            self.posed[n] = self._kinematics.joint_poses[self._joints]
            n += 1
