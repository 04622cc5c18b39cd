"""What may change in the scene of a controller between steps: obstacles come and go, objects are attached."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import inf
from typing import Any

from qpavoid.control.builder import ProblemBuilder
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.observer import MomentumObserver
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.control.pair_distances import PairDistance, pair_distances
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.model.sample import Sample
from qpavoid.model.scene import Obstacle, Scene
from qpavoid.problem import Array, require_finite


class SceneChanges:
    """Part of a `Controller` that changes its scene; a change that is refused changes nothing."""

    scene: Scene
    """Robot and obstacles, those that were added among them."""
    _builder: ProblemBuilder
    _planning: Any

    def _scene_changed(self, method: str, *arguments: Any) -> None:
        """Take note of a change that one of the methods below has made."""

    @property
    def attached(self) -> Mapping[str, int]:
        """Joint that each attached object is attached to, by name of the object."""
        table = self._builder.rows.query.table
        return {self.scene.slots[index].name: joint for index, joint in table.attached.items()}

    @property
    def obstacle_names(self) -> tuple[str, ...]:
        """Names of the obstacles in the order of the scene, which is that of the rows of an array for `step`."""
        return self._builder.tracker.names

    def add_obstacle(self, obstacle: Obstacle) -> None:
        """Add an obstacle, which takes one of the scene's spare slots until it is removed: no memory is laid out anew.

        From the next step on it is one like all others: updates, `attach` if it is graspable, `allow_contact`, reasons
        and `scene` know it by its name. Where it appears near the robot, the pair parts as one that came near by
        itself, within the acceleration limits.

        Args:
            obstacle: of `Obstacle.at`: a primitive, or a mesh with `method: convex`.

        Raises:
            ConfigError: no slot is empty, its name is taken, it has another shape, its pose cannot be true. Nothing is
                changed.
        """
        self._builder.slots.add(obstacle)
        self._scene_changed("add_obstacle", obstacle)

    def remove_obstacle(self, obstacle: str) -> None:
        """Remove an obstacle that was added; its slot is empty again.

        Args:
            obstacle: its name.

        Raises:
            UnknownName: there is none of that name.
            ConfigError: it is attached to the robot, or was built into the scene.
        """
        self._builder.slots.remove(self._builder.tracker.index(obstacle))
        self._scene_changed("remove_obstacle", obstacle)

    def attach(self, obstacle: str, frame: str, q: Array | None = None) -> None:
        """Attach an obstacle to a frame of the robot; it stays where it is relative to the frame.

        Until it is released it is a body of the robot: it keeps clear of the other obstacles and of the robot, except
        of what it touches now, until the two have once been apart, and of the link that carries it and all beyond it.
        What is given of it in `step` is not read meanwhile.

        Args:
            obstacle: name of one that is `graspable`.
            frame: name of the frame.
            q: configuration (nq,) at which it is grasped; that of the last step if left out, the home pose before the
                first one.

        Raises:
            UnknownName: no such obstacle or frame.
            ConfigError: it cannot be carried, or not by this frame.
            NumericalError: q cannot be true.
        """
        if not isinstance(frame, str):
            raise UnknownName(f"attach: no frame {frame!r:.60}; give its name")
        index, frame_id = self._builder.tracker.index(obstacle), self.scene.robot.frame_id(frame, "attach")
        q = self._builder.attach(index, frame_id, q)
        self._scene_changed("attach_at", index, frame_id, q, self._builder.pose(index, q))

    def release(self, obstacle: str, q: Array | None = None) -> Sample:
        """Release an attached obstacle: it rests where it is, until it is given to `step` again.

        Pairs of it that touch now get rows once they have been farther apart than the safety distance.

        Args:
            obstacle: its name.
            q: configuration (nq,) at which it is released; see `attach`.

        Returns:
            Its world pose.

        Raises:
            UnknownName: no such obstacle.
            ConfigError: it is not carried.
            NumericalError: q cannot be true.
        """
        sample, q = self._builder.release(self._builder.tracker.index(obstacle), q)
        self._scene_changed("release", obstacle, q)
        return sample

    def allow_contact(self, obstacle: str, others: Sequence[str], allowed: bool = True) -> None:
        """Let an obstacle and some bodies or other obstacles touch, as before a grasp.

        Args:
            obstacle: its name.
            others: names of bodies or obstacles.
            allowed: False takes it back.

        Raises:
            UnknownName: no such obstacle or body.
            ConfigError: none of the others has a pair with it.
        """
        index, known = self._builder.tracker.index(obstacle), {*self.scene.body_names, *self.scene.obstacle_names}
        try:
            names = [others] if isinstance(others, str) else list(others)
        except TypeError:
            raise UnknownName(f"allow_contact: {others!r:.60}; give a list of names") from None
        for name in names:
            if not isinstance(name, str) or name not in known:
                raise UnknownName(f"allow_contact: no body or obstacle {name!r:.60}{nearest(str(name), known)}")
        self._builder.attachments.allow(index, set(names), allowed)
        self._scene_changed("allow_contact", obstacle, names, allowed)

    def obstacle_pose(self, obstacle: str, q: Array | None = None) -> Sample:
        """Return the world pose of an obstacle in the last step, attached or not; see `release`."""
        return self._builder.pose(self._builder.tracker.index(obstacle), q)

    @property
    def obstacle_states(self) -> ObstacleStates:
        """States of all obstacles in the last step; the next one overwrites them."""
        return self._builder.tracker.current

    @property
    def observer(self) -> MomentumObserver | None:
        """What observes torques from outside; None unless `dynamics.observer` asks for it."""
        dynamics = self._builder.rows.dynamics
        return None if dynamics is None else dynamics.observer

    def set_contacts(self, frames: Collection[str], duration: float = 0.1) -> None:
        """Let the contacts of some frames come or stay, and all others leave.

        A contact that leaves bears less and less, and is free after the duration; one that comes rests where its frame
        is in the next step, and bears more and more. At velocity level, it holds its frame until the duration is over.

        Args:
            frames: those of the scenario's `contacts` that rest from now on.
            duration: time in which the load is taken over [s].

        Raises:
            UnknownName: of a frame without a contact.
            ConfigError: the controller has no contacts, or plans.
        """
        contacts = self._builder.rows.contacts
        if contacts is None or self._planning is not None:
            raise ConfigError("set_contacts: the controller was made without `contacts`, or with `planning`")
        contacts.switch(frames, duration)

    def take_over(self, other: SceneChanges) -> None:
        """Add, attach and allow what another controller of the same scene has; see `clone`."""
        self._builder.slots.take_over(other.scene)
        home, model = self.scene.robot.home, self.scene.robot.model
        for name, joint in other.attached.items():
            frame_id = model.getFrameId(model.names[joint])
            self._builder.attach(other._builder.tracker.index(name), frame_id, home, other.obstacle_pose(name, home))
        self._builder.attachments.take_over(other._builder.attachments)
        if (contacts := self._builder.rows.contacts) is not None and (own := other._builder.rows.contacts) is not None:
            contacts.take_over(own)
        self._scene_changed("take_over", other)

    def pair_distances(self, q: Array, within: float = inf) -> list[PairDistance]:
        """Return how far all bodies are from each other, obstacles being where the last step took them to be.

        It takes milliseconds, and changes nothing: for checks and displays between steps. A step itself has the pairs
        within d2, in `Tick.proximity`. Uncertainties and ages of obstacles are not taken off; of a point cloud, there
        is the nearest point to each body.

        Args:
            q: configuration (nq,).
            within: distance up to which pairs are listed [m]; all that are checked if left out.

        Returns:
            Names, distance, normal and witness points of each pair, the nearest first.

        Raises:
            NumericalError: q has the wrong shape, NaN or infinity.
        """
        q = require_finite("q", q, (self.scene.robot.model.nq,))
        return pair_distances(self.scene, self.distances(), self.obstacle_states, q, within)

    def distances(self) -> DistanceQuery:
        """Return distances of the scene in memory of their own, which know what is attached to the robot."""
        return DistanceQuery(self.scene, self._builder.rows.query.table)
