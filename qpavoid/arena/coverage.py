"""What a report does not show: who took no part, what a suite asked for and has not got, what cannot be mixed."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from qpavoid.arena.results import Results

_LISTED = 5


def gaps(results: Results, facts: Mapping[str, Any]) -> Iterator[str]:
    """A sentence for everything that is not as the suite wants it; none where all is there.

    Args:
        results: what there is.
        facts: what suite.json says of the last sweep, and its `failures`; whatever it lacks is not asked for.
    """
    yield from _families(results, facts)
    for name, family, count in results.missing():
        yield f"{name} has not run {count} cases of {family}, which count for nobody."
    for name, packages in facts.get("absent", {}).items():
        if name not in results.entrants:
            yield f"{name} does not take part: it needs {', '.join(packages)}."
    for name in sorted({entry["name"] for entry in facts.get("entrants", {}).values()} - set(results.entrants)):
        yield f"{name} was to take part, and has no run."
    yield from _failures(facts)
    if len(set(results.versions)) > 1:
        told = ", ".join(f"{name} {version}" for name, version in zip(results.entrants, results.versions, strict=True))
        yield f"**Entrants ran with different versions of qpavoid**: {told}."
    if results.replaced:
        yield (
            f"{results.replaced} rows count for nothing: an entrant has run with other settings or another version "
            "since, or the family has been changed."
        )
    if results.bounded:
        yield f"{results.bounded} figures were infinite or no numbers: they stand at the worst of all runs."


def _families(results: Results, facts: Mapping[str, Any]) -> Iterator[str]:
    """Cases that were asked for, and that nobody has run."""
    first, count = facts.get("first_seed", 0), facts.get("seeds", 0)
    seeds = results.columns["seed"][results.cell.max(axis=1)]
    asked = (seeds >= first) & (seeds < first + count)
    for family in facts.get("families", ()):
        here = results.family == results.families.index(family) if family in results.families else np.False_
        if (there := int(np.sum(asked & here))) < count:
            yield f"Nobody has run {count - there} of the {count} cases of {family} that the suite asks for."


def _failures(facts: Mapping[str, Any]) -> Iterator[str]:
    """What the last sweep could not make or run, each kind once."""
    seeds = defaultdict(list)
    for failure in facts.get("failures", ()):
        seeds[failure["family"], failure["entrant"], failure["failure"]].append(str(failure["seed"]))
    for (family, entrant, said), which in seeds.items():
        what = "could not be made" if entrant is None else f"could not be run by {entrant}"
        some = ", ".join(which[:_LISTED]) + ", …" * (len(which) > _LISTED)
        yield f"{family}, seed {some}: {what}: `{' '.join(said.replace('`', chr(39)).split())}`"
