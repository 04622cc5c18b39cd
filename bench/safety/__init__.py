"""Safety: another simulator plays what the solvers command, in thousands of random scenes, and looks for contacts."""
