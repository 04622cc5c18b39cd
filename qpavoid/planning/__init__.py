"""Collision-free paths from a configuration to goals, planned with the bodies and pairs of a scene."""
