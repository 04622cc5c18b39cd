"""Turn the inputs of a control step into a problem: obstacles, distances, tasks, limits, rows."""
