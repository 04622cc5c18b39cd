"""Families of scenarios: parameters in a YAML file each, and cases with known solutions."""

from qpavoid.arena.families.family import Family, load_family
from qpavoid.arena.families.make import make_case
from qpavoid.arena.families.parameters import Draw, Redraw
from qpavoid.config.shipped import family_names

__all__ = ["Draw", "Family", "Redraw", "family_names", "load_family", "make_case"]
