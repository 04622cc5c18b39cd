"""What is built once: robot, scene, trajectories."""
