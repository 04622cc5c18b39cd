"""A robot of your own from a bare URDF, with collision capsules fitted to its meshes."""

from qpavoid import Robot
from qpavoid.config.shipped import example_robot_data

urdf = example_robot_data() / "example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"  # put your path here
home = {"shoulder_lift_joint": -1.57, "elbow_joint": 1.57, "wrist_1_joint": -1.57, "wrist_2_joint": -1.57}
robot = Robot.from_urdf(urdf, bodies="capsule", home=home)

print(f"{robot.name}: {robot.model.nq} joints, {len(robot.bodies.geometryObjects)} bodies")
print(f"{len(robot.bodies.collisionPairs)} pairs are watched")
for note in robot.notes:
    print(f"  {note}")
