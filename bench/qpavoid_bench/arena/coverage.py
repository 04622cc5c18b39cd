"""Gaps of a report: absent entrants, missing cases and runs, mixed versions, failures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from qpavoid_bench.arena.results import Results

_MAX_SEEDS_SHOWN = 5


def missing_results(results: Results, facts: Mapping[str, Any]) -> Iterator[str]:
    """Describe everything that is not as the suite asks, a sentence each.

    Args:
        results: what there is.
        facts: what suite.json says of the last sweep, and its `failures`; whatever it lacks is not asked for.
    """
    yield from _missing_families(results, facts)
    for name, family, count in results.missing():
        yield f"{name} has not run {count} cases of {family}, which count for no entrant."
    for name, packages in facts.get("absent", {}).items():
        if name not in results.entrants:
            yield f"{name} does not take part: it needs {', '.join(packages)}."
    for name in sorted({entry["name"] for entry in facts.get("entrants", {}).values()} - set(results.entrants)):
        yield f"{name} was to take part, and has no run."
    yield from _failures(facts)
    if len(set(results.versions)) > 1:
        listed_versions = ", ".join(
            f"{name} {version}" for name, version in zip(results.entrants, results.versions, strict=True)
        )
        yield f"**Entrants ran with different versions of qpavoid**: {listed_versions}."
    if results.replaced:
        yield (
            f"{results.replaced} rows count for nothing: an entrant has run with other settings or another version "
            "since, or the family has been changed."
        )
    if results.bounded:
        yield f"{results.bounded} figures were infinite or no numbers: they stand at the worst of all runs."


def _missing_families(results: Results, facts: Mapping[str, Any]) -> Iterator[str]:
    """Describe cases that the suite asks for and that no entrant has run."""
    first, count = facts.get("first_seed", 0), facts.get("seeds", 0)
    seeds = results.columns["seed"][results.cell.max(axis=1)]
    in_suite = (seeds >= first) & (seeds < first + count)
    for family in facts.get("families", ()):
        in_family = results.family == results.families.index(family) if family in results.families else np.False_
        if (count_run := int(np.sum(in_suite & in_family))) < count:
            yield f"No entrant has run {count - count_run} of the {count} cases of {family} that the suite asks for."


def _failures(facts: Mapping[str, Any]) -> Iterator[str]:
    """Describe what the last sweep could not make or run, each kind once."""
    seeds = defaultdict(list)
    for failure in facts.get("failures", ()):
        seeds[failure["family"], failure["entrant"], failure["failure"]].append(str(failure["seed"]))
    for (family, entrant, message), seeds_of_failure in seeds.items():
        outcome = "could not be made" if entrant is None else f"could not be run by {entrant}"
        seeds_shown = ", ".join(seeds_of_failure[:_MAX_SEEDS_SHOWN]) + ", …" * (
            len(seeds_of_failure) > _MAX_SEEDS_SHOWN
        )
        yield f"{family}, seed {seeds_shown}: {outcome}: `{' '.join(message.replace('`', chr(39)).split())}`"
