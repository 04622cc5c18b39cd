"""Benchmarks of qpavoid; never part of the wheel."""
