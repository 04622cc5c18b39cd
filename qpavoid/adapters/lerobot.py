"""LeRobot: a step of its robot action pipeline that makes the actions of policies and teleoperators safe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.processor import ProcessorStepRegistry, RobotActionProcessorStep, TransitionKey

from qpavoid.adapters.actions import ActionFilter
from qpavoid.adapters.handover import Handover
from qpavoid.config.loading import load_scenario
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError
from qpavoid.problem import Array


@dataclass
@ProcessorStepRegistry.register("qpavoid_safety_filter")
class SafetyFilterStep(RobotActionProcessorStep):  # type: ignore[misc]
    """Replaces joint positions of an action by safe ones; what is no joint of the robot stays as it is."""

    scenario: str
    """Scenario with the robot and its obstacles; its dt is that of the loop, 1/fps."""
    joints: dict[str, str] = field(default_factory=dict)
    """Joint of each key of actions and observations; left out: `NAME.pos` is joint NAME."""
    degrees: bool = True
    """Whether angles are in degrees, as those of LeRobot's arms with `use_degrees`."""

    def __post_init__(self) -> None:
        """Build the controller.

        Raises:
            ConfigError: of the scenario, or a joint of the robot that no key stands for.
        """
        controller, _ = Controller.from_scenario(load_scenario(self.scenario))
        robot = controller.scene.robot
        keys = {joint: key for key, joint in self.joints.items()} or {name: f"{name}.pos" for name in robot.joint_names}
        if missing := [name for name in robot.joint_names if name not in keys]:
            raise ConfigError(f"joints: no key for {', '.join(missing)}; lock them in the scenario, or name their keys")
        self._keys = [keys[name] for name in robot.joint_names]
        turns = np.array([unit == "rad" for unit in robot.coordinate_units])
        self._unit = np.where(turns & self.degrees, np.pi / 180.0, 1.0)
        self.filter = ActionFilter(controller)
        """What makes actions safe; `filter.solution` says why the last one was changed."""
        self.obstacles = Handover()
        """Where obstacles are: `obstacles.put(name, pose)`, from any thread."""

    def action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Return the action with safe positions."""
        observation = self.transition[TransitionKey.OBSERVATION]
        positions = self.filter(self._read(observation), self._read(action), obstacles=self.obstacles.take())
        return {**action, **dict(zip(self._keys, (positions / self._unit).tolist(), strict=True))}

    def chunk(self, observation: Mapping[str, Any], actions: Any, obstacles: Mapping[str, Any] | None = None) -> Array:
        """Return a chunk of a policy (T, n), columns in the order of the robot's joints, as it can be followed safely.

        Nothing is sent; each action is filtered again when it is carried out.
        """
        chunk = self.filter.chunk(self._read(observation), np.asarray(actions) * self._unit, obstacles)
        return chunk.actions / self._unit

    def reset(self) -> None:
        """Begin where the robot is, as before an episode."""
        self.filter.reset()

    def get_config(self) -> dict[str, Any]:
        """Return what a saved pipeline keeps."""
        return {"scenario": self.scenario, "joints": self.joints, "degrees": self.degrees}

    def transform_features(self, features: Any) -> Any:
        """Return the features: they stay as they are."""
        return features

    def _read(self, values: Mapping[str, Any]) -> Array:
        return np.array([float(values[key]) for key in self._keys]) * self._unit
