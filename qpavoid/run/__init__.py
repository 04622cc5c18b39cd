"""Closed loops: simulation, log, key figures, batches."""
