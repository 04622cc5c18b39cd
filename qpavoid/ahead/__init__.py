"""What lies ahead: of a velocity, of a flight from obstacles that move, and of a task that is blocked."""
