"""From depth images to the points of a cloud, without the robot that is in the picture."""
