"""Kernels that call large kernels instead of containing them: each of those is optimised once, not in every caller.

numba links the code of a kernel into each kernel that calls it, where LLVM optimises and assembles it once more, and so
on for the callers of these. That pays for small kernels, which become part of their callers; large ones LLVM leaves as
they are, and the work was for nothing. Here a large kernel is linked as a name alone, as functions of libraries are.

Code on disk then has names that are not defined in it: beside it is what has to be loaded before it.
"""

from __future__ import annotations

from importlib import import_module
from itertools import islice
from typing import Any, NamedTuple

from llvmlite import binding

LARGE = 250
"""Instructions from which on a kernel is not linked into its callers [-]: LLVM inlines none of a fourth of that."""


class Symbol(NamedTuple):
    """A large kernel by the name that its callers know."""

    name: str
    module: str
    kernel: str
    arguments: Any
    """Their types."""

    def define(self) -> None:
        """Load or compile the kernel, so that the name stands for its code."""
        kernel = getattr(import_module(self.module), self.kernel)
        kernel.compile(self.arguments)
        code = kernel.overloads[self.arguments]
        if code.fndesc.llvm_func_name != self.name:  # numba counts in names: another process may have counted otherwise
            binding.add_symbol(self.name, code.library.get_pointer_to_function(code.fndesc.llvm_func_name))


class Links(NamedTuple):
    """How the code of a kernel hangs together with that of others."""

    called: list[Symbol]
    """Large kernels that it calls, or that small ones in it call."""
    defined: list[str]
    """Names that it defines."""
    own: Symbol | None
    """Its own name if it is large."""


_symbols: dict[str, Symbol] = {}
"""Large kernels that callers may call by their names."""


def take_out_of_callers(code: Any, function: Any) -> None:
    """Let the callers of a kernel that are compiled from now on call it by its name, if it is large.

    Args:
        code: what numba compiled.
        function: Python source of the kernel.
    """
    name = code.fndesc.llvm_func_name
    if "." not in function.__qualname__ and _is_large(code.library.get_function(name)):
        code.library._shared_module = binding.parse_assembly("")  # what numba links into callers
        _symbols[name] = Symbol(name, function.__module__, function.__qualname__, code.signature.args)


def links_of(code: Any) -> Links:
    """Return what has to be known before a kernel's code can be loaded."""
    called, defined = list[Symbol](), list[str]()
    for function in code.library._final_module.functions:
        if not function.is_declaration:
            defined.append(function.name)
        elif function.name in _symbols:
            called.append(_symbols[function.name])
    return Links(called, defined, _symbols.get(code.fndesc.llvm_func_name))


def prepare(target: Any, links: Links) -> None:
    """Make all names known that the code of a kernel calls or defines, before it is loaded.

    Args:
        target: numba's compiler for this machine.
        links: of the code.
    """
    for symbol in links.called:
        symbol.define()
        _symbols[symbol.name] = symbol
    if links.own is not None:
        _symbols[links.own.name] = links.own
    target.codegen()._engine._defined_symbols.update(links.defined)  # numba reads them off what callers link


def _is_large(function: Any) -> bool:
    """Return True if a function has `LARGE` instructions or more."""
    instructions = (instruction for block in function.blocks for instruction in block.instructions)
    return next(islice(instructions, LARGE - 1, None), None) is not None
