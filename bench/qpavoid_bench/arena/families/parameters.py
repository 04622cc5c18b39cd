"""Parameters of a family: ranges that its file states, and draws from them."""

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
    """Common fields of all parameters."""

    about: Annotated[str, Field(min_length=1)]
    """Meaning of the parameter, with its unit."""


class RangeBlock(ParameterBlock):
    """Common fields of numbers of a range."""

    range: tuple[Number, Number]
    """Lowest and highest value."""
    whole: bool = False
    """Whole numbers only, both ends included."""

    @model_validator(mode="after")
    def _check_range(self) -> RangeBlock:
        low, high = self.range
        if not low < high:
            raise ValueError(f"range: needs low < high, got {low:g}, {high:g}")
        if self.whole and (low != round(low) or high != round(high)):
            raise ValueError(f"range: {low:g}, {high:g} are not whole numbers; round them, or leave `whole` out")
        return self


class Uniform(RangeBlock):
    """Equally likely values."""

    type: Literal["uniform"]

    def draw(self, random: np.random.Generator) -> float:
        """Draw a value of the range."""
        low, high = self.range
        return int(random.integers(int(low), int(high) + 1)) if self.whole else float(random.uniform(low, high))


class LogUniform(RangeBlock):
    """Values with equally likely logarithms: as many from 2 to 4 as from 20 to 40."""

    type: Literal["log_uniform"]
    range: tuple[Positive, Positive]
    """Lowest and highest value."""

    def draw(self, random: np.random.Generator) -> float:
        """Draw a value of the range."""
        low, high = self.range
        value = float(np.exp(random.uniform(np.log(low), np.log(high + self.whole))))
        return min(int(value), int(high)) if self.whole else value


class Choice(ParameterBlock):
    """One of some values, all equally likely."""

    type: Literal["choice"]
    of: Annotated[list[Any], Field(min_length=1)]
    """The values: anything that a file can hold."""

    def draw(self, random: np.random.Generator) -> Any:
        """Draw one of the values."""
        return self.of[int(random.integers(len(self.of)))]


class Direction(ParameterBlock):
    """Unit vectors [x, y, z], even over the sphere."""

    type: Literal["direction"]

    def draw(self, random: np.random.Generator) -> list[float]:
        """Draw a unit vector."""
        vector = random.normal(size=3)
        return [float(value) for value in vector / np.linalg.norm(vector)]


Parameter = Annotated[Uniform | LogUniform | Choice | Direction, Field(discriminator="type")]


class Redraw(Exception):
    """Raised by a generator whose draw makes no scenario: another draw follows."""


class Draw:
    """One draw of a family: values of its parameters by name.

    Each parameter has a stream of random numbers of its own, made from seed, number of the draw and its name: adding
    one leaves the others as they are.
    """

    def __init__(self, parameters: Mapping[str, Parameter], seed: int, number: int, constant: frozenset[str]) -> None:
        """Seed the draw; values are drawn when they are asked for.

        Args:
            parameters: what can be drawn.
            seed: of the case.
            number: of the draw, from 0; one that makes no case is followed by another one.
            constant: those that keep the value of their first draw: a template has them.
        """
        self._parameters, self._key, self._constant = parameters, (seed, number), constant
        self._streams: dict[str, np.random.Generator] = {}
        self._values: dict[str, Any] = {}

    def __call__(self, name: str) -> Any:
        """Draw a value: always the same of a template's parameter, a new one of others.

        Raises:
            UnknownName: the family has no such parameter.
        """
        if name in self._values:
            return self._values[name]
        if name not in self._parameters:
            raise UnknownName(f"unknown parameter {name!r}{nearest(name, self._parameters)}")
        if name not in self._streams:
            self._streams[name] = np.random.default_rng([*self._key, crc32(name.encode())])
        value = self._parameters[name].draw(self._streams[name])
        if name in self._constant:
            self._values[name] = value
        return value

    def vector(self, *names: str) -> Array:
        """Draw values (len(names),) of several parameters."""
        return np.array([self(name) for name in names], dtype=np.float64)

    @property
    def names_drawn(self) -> frozenset[str]:
        """Return the names of the parameters that were drawn."""
        return frozenset(self._streams)
