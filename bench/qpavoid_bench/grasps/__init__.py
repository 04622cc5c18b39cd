"""Grasps of a public problem set: how close the bodies of shipped robots let them come."""
