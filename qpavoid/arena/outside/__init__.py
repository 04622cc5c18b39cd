"""Other libraries as entrants: each is given the same robot, pairs, targets and obstacles, and used as it documents."""
