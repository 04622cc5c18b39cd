"""Families of scenarios: parameters in a YAML file each, and cases with known solutions."""

from qpavoid.config.shipped import shipped_names
from qpavoid_bench.arena.families.family import Family, load_family
from qpavoid_bench.arena.families.make import make_case
from qpavoid_bench.arena.families.parameters import Draw, Redraw

__all__ = ["Draw", "Family", "Redraw", "load_family", "make_case", "shipped_names"]
