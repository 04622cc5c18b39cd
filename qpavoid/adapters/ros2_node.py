"""ROS 2 node: joint states and obstacle poses in, safe joint velocities or trajectory points out.

`python3 -m qpavoid.adapters.ros2_node --ros-args -p scenario:=mine.yaml`, in a Python that has `rclpy` and qpavoid.
"""

from __future__ import annotations

from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from qpavoid.adapters.ros2 import NodeLogic
from qpavoid.errors import ConfigError


class QpavoidNode(Node):  # type: ignore[misc]
    """Subscribes and publishes for `NodeLogic`; with one executor thread, which is the default of `rclpy.spin`.

    | topic | type | what |
    |---|---|---|
    | `joint_states` | JointState | of the robot, in any order, among others |
    | `~/desired` | JointState | velocity to make safe (mode `filter`) |
    | `~/obstacles/NAME` | PoseStamped | of each obstacle of the scenario with `source: external` |
    | `~/targets/NAME` | PoseStamped | of each task (mode `tasks`) |
    | `~/velocity` | Float64MultiArray | for a JointGroupVelocityController (output `velocity`) |
    | `~/trajectory` | JointTrajectory | one point, for a JointTrajectoryController (output `trajectory`) |
    | `~/status` | String | status and reasons, where they change |
    """

    def __init__(self) -> None:
        """Read the parameters `scenario`, `mode`, `output`, `timeout` and `frame`, and begin."""
        super().__init__("qpavoid")
        defaults = {"scenario": "", "mode": "filter", "output": "velocity", "timeout": 0.1, "frame": "world"}
        given = {name: self.declare_parameter(name, value).value for name, value in defaults.items()}
        if given["output"] not in ("velocity", "trajectory"):
            raise ConfigError(f"output: {given['output']!r}, expected velocity or trajectory")
        self.logic = NodeLogic(given["scenario"], given["mode"], given["timeout"])
        self._frame, self._output, self._said = given["frame"], given["output"], ""
        self._begin = self.get_clock().now().nanoseconds  # numbers of a time since then are fine enough
        controller = self.logic.controller
        self.create_subscription(JointState, "joint_states", self._take_state, 1)
        self.create_subscription(JointState, "~/desired", self._take_desired, 1)
        for kind, names in (
            ("obstacles", [o.name for o in controller.scene.obstacles if o.external]),
            ("targets", [task.settings.label for task in controller.tasks]),
        ):
            for name in names:
                topic = f"~/{kind}/{name.replace(' ', '_')}"
                self.create_subscription(PoseStamped, topic, lambda m, k=kind, n=name: self._take_pose(k, n, m), 1)
        self._velocity = self.create_publisher(Float64MultiArray, "~/velocity", 1)
        self._trajectory = self.create_publisher(JointTrajectory, "~/trajectory", 1)
        self._status = self.create_publisher(String, "~/status", 1)
        self.create_timer(controller.dt, self._step)

    def _now(self) -> float:
        return float(1e-9 * (self.get_clock().now().nanoseconds - self._begin))

    def _take_state(self, message: Any) -> None:
        self.logic.joint_state(message.name, message.position, self._now())

    def _take_desired(self, message: Any) -> None:
        self.logic.desired(message.name, message.velocity, self._now())

    def _take_pose(self, kind: str, name: str, message: Any) -> None:
        if message.header.frame_id not in ("", self._frame):
            self.get_logger().error(f"{kind}/{name}: in {message.header.frame_id!r}, expected {self._frame!r}: ignored")
            return
        p, o, stamp = message.pose.position, message.pose.orientation, message.header.stamp
        place, quaternion = (p.x, p.y, p.z), (o.x, o.y, o.z, o.w)
        if kind == "targets":
            self.logic.target(name, place, quaternion)
        else:
            t = 1e-9 * (stamp.sec * 1_000_000_000 + stamp.nanosec - self._begin)
            self.logic.obstacle(name, place, quaternion, t)

    def _step(self) -> None:
        command = self.logic.step(self._now())
        if command is None:
            return
        if self._output == "velocity":
            self._velocity.publish(Float64MultiArray(data=command.velocities.tolist()))
        else:
            point = JointTrajectoryPoint(positions=command.positions.tolist(), velocities=command.velocities.tolist())
            point.time_from_start.nanosec = round(1e9 * self.logic.controller.dt)
            self._trajectory.publish(JointTrajectory(joint_names=list(command.names), points=[point]))
        said = " ".join(map(str, (command.solution.status.value, *(r.kind.name for r in command.solution.reasons))))
        if said != self._said:
            self._said = said
            self._status.publish(String(data="; ".join(map(str, (said, *command.solution.reasons)))))


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    try:
        rclpy.spin(QpavoidNode())
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
