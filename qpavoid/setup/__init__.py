"""From a URDF to a robot.yaml: looks a robot over, and writes what a URDF does not say."""
