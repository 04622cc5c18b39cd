"""A robot of your own from a bare URDF, with collision capsules fitted to its meshes."""

from qpavoid import Robot
from qpavoid.config.shipped import example_robot_data

urdf = example_robot_data() / "example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"  # put your path here
robot = Robot.from_urdf(urdf, bodies="capsule")

print(f"{robot.name}: {robot.model.nq} joints, {len(robot.bodies.geometryObjects)} bodies")
print(f"{len(robot.bodies.collisionPairs)} pairs are watched")
for note in robot.notes:
    print(f"  {note}")
