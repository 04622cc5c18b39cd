"""Benchmarks of qpavoid: controllers and libraries compared on families of scenarios, judged by a simulator."""
