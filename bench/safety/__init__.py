"""Safety campaign: another simulator runs what the solvers command, in random scenes, and detects contacts."""
