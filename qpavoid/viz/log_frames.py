"""What a view or a film shows of a saved run: its frames, with distances computed anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.config.loading import validate
from qpavoid.config.shipped import find_shipped
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.controller import Controller
from qpavoid.errors import QpavoidError
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.sample import Sample
from qpavoid.problem import Array
from qpavoid.reason import Severity
from qpavoid.run.log import STATUSES, Log
from qpavoid.viz.view_link import Frame, obstacles_of_pairs
from qpavoid.viz.view_status import closest_html, page_html


class LogFrames:
    """The frames of a log."""

    def __init__(self, log: Log) -> None:
        """Build the robot and scene of a log.

        Raises:
            ConfigError, UnknownName: a file of its robot or scenario is not where it was.
        """
        self.log, self.config = log, scenario_of(log)
        self._controller = Controller.from_scenario(self.config)[0]
        self.robot = self._controller.scene.robot
        """The robot of the run."""
        self._kinematics, self._query = ForwardKinematics(self.robot.model), self._controller.distances()
        avoidance, slots = self.config.avoidance, self._controller.scene.slots
        self.levels: Array = np.array([avoidance.d1, avoidance.d2]) - avoidance.offset
        """(2,) d1 and d2, between surfaces [m]."""
        columns = {described["name"]: i for i, described in enumerate(log.meta["obstacles"])}
        self._columns = [columns.get(slot.name, -1) for slot in slots]
        slots_of_pairs = obstacles_of_pairs(self._controller.scene)
        self._obstacle_columns = np.array([-1, *self._columns])[1 + slots_of_pairs]

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.log.t)

    @property
    def closest_step(self) -> int:
        """Return the step of the least distance."""
        return int(np.argmin(self.log.min_distance))

    def frame(self, step: int) -> Frame:
        """Return what is shown of a step."""
        log = self.log
        targets = np.zeros((log.target.shape[1], 12))
        targets[:, [0, 4, 8]], targets[:, 9:] = 1.0, log.target[step]
        rotation = np.swapaxes(log.obstacle_rotation[step], 1, 2).reshape(-1, 9)
        obstacles = np.nan_to_num(np.concatenate((rotation, log.obstacle_position[step]), axis=1))
        return Frame(
            float(log.t[step]), log.q[step], log.v[step], self._witnesses(step), log.tool[step], targets, obstacles,
            self.levels, np.zeros((0, 2 + log.q.shape[1])), np.flatnonzero(log.body_distance[step] < 0.0).astype(float),
            self._text(step),
        )  # fmt: skip

    def _witnesses(self, step: int) -> Array:
        """Return distance, witness points and obstacle (k, 8) of the pairs within the influence distance."""
        self._kinematics.compute(self.log.q[step])
        samples = [self._sample(number, step) for number in range(len(self._columns))]
        if samples:
            self._query.place(ObstacleStates.of(samples))
        self._query.compute(self._kinematics.joint_poses, float(self.levels[1]))
        pairs = np.asarray(self._query.pairs)
        results = self._query.arrays.results[pairs]
        columns = np.column_stack((results[:, [0, 4, 5, 6, 7, 8, 9]], self._obstacle_columns[pairs]))
        return np.asarray(columns[results[:, 0] < self.levels[1]])

    def _sample(self, number: int, step: int) -> Sample:
        column, obstacle = self._columns[number], self._controller.scene.slots[number]
        if column < 0 or obstacle.name in self._controller.attached:
            return obstacle.motion.sample(0.0)
        position, rotation = self.log.obstacle_position[step, column], self.log.obstacle_rotation[step, column]
        return Sample.at(position, rotation) if np.isfinite(position).all() else obstacle.motion.sample(0.0)

    def _text(self, step: int) -> str:
        log, closest = self.log, ""
        if log.closest_pair[step] >= 0:
            a, b = log.meta["pairs"][log.closest_pair[step]]
            closest = closest_html(a, b, float(log.min_distance[step]), float(self.levels[0]))
        events = [event for event in log.meta["events"] if event[0] <= log.t[step] + 1e-9]
        reasons = [
            (reason["text"], Severity[reason["severity"]])
            for reason in (events[-1][2] if events and log.severity[step] else ())
        ]
        return page_html(STATUSES[log.status[step]], float(log.t[step]), closest, reasons)


def scenario_of(log: Log) -> ScenarioConfig:
    """Return the scenario of a log, with the file that it was read from, if that can be found.

    Raises:
        ConfigError: it is of another version.
    """
    name = Path(str(log.meta.get("source") or "scenario.yaml"))
    config = validate(log.meta["config"], ScenarioConfig, name)
    try:
        return config.with_source(name if name.is_file() else find_shipped("scenario", str(log.meta["scenario"])))
    except QpavoidError:
        return config.with_source(name)
