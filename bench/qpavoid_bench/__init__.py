"""Benchmark of qpavoid: one control step beside other libraries, back ends, endurance."""
