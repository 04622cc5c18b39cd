"""Other libraries as entrants, with the same robot, pairs, targets and obstacles.

Each is used as it documents.
"""
