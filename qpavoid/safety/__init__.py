"""Turn a solution into a command: look-ahead, backup trajectories, progress."""
