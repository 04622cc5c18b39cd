"""Benchmarks of qpavoid: families of scenarios judged by a simulator, the time of a step, back ends, endurance."""
