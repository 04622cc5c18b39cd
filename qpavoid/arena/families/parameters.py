"""Parameters of a family: the ranges that its file states, and what is drawn from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal
from zlib import crc32

import numpy as np
from pydantic import Field, model_validator

from qpavoid.config.base import Block, Number, Positive
from qpavoid.errors import UnknownName, nearest
from qpavoid.problem import Array


class ParameterBlock(Block):
    """What all parameters share."""

    about: Annotated[str, Field(min_length=1)]
    """What it is, with its unit."""


class Uniform(ParameterBlock):
    """Equally likely values."""

    type: Literal["uniform"]
    range: tuple[Number, Number]
    """Lowest and highest value."""
    whole: bool = False
    """Whole numbers only, both ends included."""

    @model_validator(mode="after")
    def _rises(self) -> Uniform:
        _check(self.range, self.whole)
        return self

    def draw(self, random: np.random.Generator) -> float:
        """A value of the range."""
        low, high = self.range
        return int(random.integers(int(low), int(high) + 1)) if self.whole else float(random.uniform(low, high))


class LogUniform(ParameterBlock):
    """Values with equally likely logarithms: as many from 2 to 4 as from 20 to 40."""

    type: Literal["log_uniform"]
    range: tuple[Positive, Positive]
    """Lowest and highest value."""
    whole: bool = False
    """Whole numbers only, both ends included."""

    @model_validator(mode="after")
    def _rises(self) -> LogUniform:
        _check(self.range, self.whole)
        return self

    def draw(self, random: np.random.Generator) -> float:
        """A value of the range."""
        low, high = self.range
        value = float(np.exp(random.uniform(np.log(low), np.log(high + self.whole))))
        return min(int(value), int(high)) if self.whole else value


class Choice(ParameterBlock):
    """One of some values, all equally likely."""

    type: Literal["choice"]
    of: Annotated[list[Any], Field(min_length=1)]
    """The values: anything that a file can hold."""

    def draw(self, random: np.random.Generator) -> Any:
        """One of the values."""
        return self.of[int(random.integers(len(self.of)))]


class Direction(ParameterBlock):
    """Unit vectors [x, y, z], even over the sphere."""

    type: Literal["direction"]

    def draw(self, random: np.random.Generator) -> list[float]:
        """A unit vector."""
        vector = random.normal(size=3)
        return [float(value) for value in vector / np.linalg.norm(vector)]


Parameter = Annotated[Uniform | LogUniform | Choice | Direction, Field(discriminator="type")]


def _check(limits: tuple[float, float], whole: bool) -> None:
    low, high = limits
    if not low < high:
        raise ValueError(f"range: needs low < high, got {low:g}, {high:g}")
    if whole and (low != round(low) or high != round(high)):
        raise ValueError(f"range: {low:g}, {high:g} are not whole numbers; round them, or leave `whole` out")


class Redraw(Exception):
    """Raised by a generator whose draw makes no scenario: another one is taken."""


class Draw:
    """One draw of a family: gives values of its parameters by name.

    Each parameter has a stream of random numbers of its own, made from seed, number of the draw and its name: adding
    one leaves the others as they are.
    """

    def __init__(self, parameters: Mapping[str, Parameter], seed: int, number: int, once: frozenset[str]) -> None:
        """Draws nothing yet.

        Args:
            parameters: what can be drawn.
            seed: of the case.
            number: of the draw, from 0; one that makes no case is followed by another one.
            once: those that keep the value of their first draw: a template has them.
        """
        self._parameters, self._key, self._once = parameters, (seed, number), once
        self._streams: dict[str, np.random.Generator] = {}
        self._kept: dict[str, Any] = {}

    def __call__(self, name: str) -> Any:
        """A value: of a parameter that stands in the family's template always the same, of others a new one each time.

        Raises:
            UnknownName: the family has no such parameter.
        """
        if name in self._kept:
            return self._kept[name]
        if name not in self._parameters:
            raise UnknownName(f"unknown parameter {name!r}{nearest(name, self._parameters)}")
        if name not in self._streams:
            self._streams[name] = np.random.default_rng([*self._key, crc32(name.encode())])
        value = self._parameters[name].draw(self._streams[name])
        if name in self._once:
            self._kept[name] = value
        return value

    def vector(self, *names: str) -> Array:
        """Values of several parameters, (len(names),)."""
        return np.array([self(name) for name in names], dtype=np.float64)

    @property
    def drawn(self) -> frozenset[str]:
        """Names of the parameters that were asked for."""
        return frozenset(self._streams)
