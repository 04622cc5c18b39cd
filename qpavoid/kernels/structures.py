"""Memory of the kernels as structures of compiled code: each named tuple of arrays becomes one argument."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba import config, typeof, types
from numba.core import cgutils, imputils
from numba.core.datamodel import default_manager, models
from numba.experimental import structref
from numba.extending import intrinsic, lower_getattr_generic

from qpavoid.kernels.approach import ApproachArrays
from qpavoid.kernels.dynamics import DynamicsArrays
from qpavoid.kernels.estimates import ObstacleArrays
from qpavoid.kernels.kinematics import KinematicsArrays
from qpavoid.kernels.layout import RowLayout
from qpavoid.kernels.near_pairs import DistanceArrays
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.planning import PlanningArrays
from qpavoid.kernels.rollout import RolloutArrays
from qpavoid.kernels.standing_layout import StandingArrays


@structref.register
class _Structure(types.StructRef):  # type: ignore[misc]
    """Type of a structure, made of those of its fields."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Return the types of the fields, without the literal values that numba infers."""
        return tuple((name, types.unliteral(field)) for name, field in fields)


class _Memory(_Structure):
    """Type of a structure whose arrays stay the same: code looks into them, and counts no references to them.

    Each count is an atomic addition; together they took two fifths of a control step. The structure has a reference to
    each array, and its owner outlives every call, so none of them is freed meanwhile: no field may be assigned, and no
    kernel may return one to Python.
    """


@lower_getattr_generic(_Memory)
def _read_field(context: Any, builder: Any, kind: Any, structure: Any, name: str) -> Any:
    """Write code that reads a field."""
    data = structref._Utils(context, builder, kind).get_data_struct(structure)
    return _borrowed(context, builder, kind.field_dict[name], getattr(data, name))


def _borrowed(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return a value whose arrays have nothing to count references in."""
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        parts = cgutils.unpack_tuple(builder, value, len(kind))
        borrowed = [_borrowed(context, builder, *part) for part in zip(kind, parts, strict=True)]
        return context.make_tuple(builder, kind, borrowed)
    return imputils.impl_ret_borrowed(context, builder, kind, value)


class PackedKinematics(structref.StructRefProxy):  # type: ignore[misc]
    """`KinematicsArrays` in compiled code."""


class PackedDistances(structref.StructRefProxy):  # type: ignore[misc]
    """`DistanceArrays` in compiled code."""


class PackedRows(structref.StructRefProxy):  # type: ignore[misc]
    """A `RowLayout` in compiled code."""


class PackedRollout(structref.StructRefProxy):  # type: ignore[misc]
    """`RolloutArrays` in compiled code."""


class PackedObstacles(structref.StructRefProxy):  # type: ignore[misc]
    """`ObstacleArrays` in compiled code."""


class PackedDynamics(structref.StructRefProxy):  # type: ignore[misc]
    """`DynamicsArrays` in compiled code."""


class PackedStanding(structref.StructRefProxy):  # type: ignore[misc]
    """`StandingArrays` in compiled code."""


class PackedStandingType(_Memory):
    """Type of `PackedStanding`."""


class PackedDynamicsType(_Memory):
    """Type of `PackedDynamics`."""


class PackedObstaclesType(_Memory):
    """Type of `PackedObstacles`."""


class PackedKinematicsType(_Memory):
    """Type of `PackedKinematics`."""


class PackedDistancesType(_Memory):
    """Type of `PackedDistances`."""


class PackedRowsType(_Memory):
    """Type of `PackedRows`."""


class PackedPlanning(structref.StructRefProxy):  # type: ignore[misc]
    """`PlanningArrays` in compiled code."""


class PackedPlanningType(_Memory):
    """Type of `PackedPlanning`."""


class PackedApproach(structref.StructRefProxy):  # type: ignore[misc]
    """`ApproachArrays` in compiled code."""


class PackedApproachType(_Memory):
    """Type of `PackedApproach`."""


class PackedRolloutType(_Memory):
    """Type of `PackedRollout`."""


for proxy, kind, fields in (
    (PackedKinematics, PackedKinematicsType, KinematicsArrays._fields),
    (PackedDistances, PackedDistancesType, DistanceArrays._fields),
    (PackedRows, PackedRowsType, RowLayout._fields),
    (PackedRollout, PackedRolloutType, RolloutArrays._fields),
    (PackedApproach, PackedApproachType, ApproachArrays._fields),
    (PackedPlanning, PackedPlanningType, PlanningArrays._fields),
    (PackedObstacles, PackedObstaclesType, ObstacleArrays._fields),
    (PackedDynamics, PackedDynamicsType, DynamicsArrays._fields),
    (PackedStanding, PackedStandingType, StandingArrays._fields),
):
    default_manager.register(kind, models.StructRefModel)
    structref.define_boxing(kind, proxy)
    structref.define_constructor(proxy, kind, list(fields))


@compiled
def _pack_kinematics(fields: Any) -> Any:
    """Return a structure of the fields of `KinematicsArrays`."""
    return PackedKinematics(*fields)


@compiled
def _pack_distances(fields: Any) -> Any:
    """Return a structure of the fields of `DistanceArrays`."""
    return PackedDistances(*fields)


@compiled
def _pack_rows(fields: Any) -> Any:
    """Return a structure of the fields of a `RowLayout`."""
    return PackedRows(*fields)


@compiled
def _pack_rollout(fields: Any) -> Any:
    """Return a structure of `RolloutArrays`."""
    return PackedRollout(*fields)


@compiled
def _pack_approach(fields: Any) -> Any:
    """Return a structure of `ApproachArrays`."""
    return PackedApproach(*fields)


@compiled
def _pack_planning(fields: Any) -> Any:
    """Return a structure of `PlanningArrays`."""
    return PackedPlanning(*fields)


@compiled
def _pack_obstacles(fields: Any) -> Any:
    """Return a structure of `ObstacleArrays`."""
    return PackedObstacles(*fields)


@compiled
def _pack_dynamics(fields: Any) -> Any:
    """Return a structure of the fields of `DynamicsArrays`."""
    return PackedDynamics(*fields)


@compiled
def _pack_standing(fields: Any) -> Any:
    """Return a structure of the fields of `StandingArrays`."""
    return PackedStanding(*fields)


_PACK = {
    KinematicsArrays: _pack_kinematics,
    DistanceArrays: _pack_distances,
    RowLayout: _pack_rows,
    RolloutArrays: _pack_rollout,
    ApproachArrays: _pack_approach,
    PlanningArrays: _pack_planning,
    ObstacleArrays: _pack_obstacles,
    DynamicsArrays: _pack_dynamics,
    StandingArrays: _pack_standing,
}


def pack(
    layout: KinematicsArrays
    | DistanceArrays
    | RowLayout
    | RolloutArrays
    | ApproachArrays
    | ObstacleArrays
    | PlanningArrays
    | DynamicsArrays
    | StandingArrays,
) -> Any:
    """Return memory in the form that the kernels take; both look into the same arrays.

    With `NUMBA_DISABLE_JIT=1` that is the named tuple itself.
    """
    return layout if config.DISABLE_JIT else _PACK[type(layout)](tuple(layout))


def direct(kernel: Any, *arguments: Any) -> Callable[..., Any]:
    """Return the machine code of a kernel for the types of some arguments, which the kernel is called with once.

    numba finds out the types of all arguments in every call, which costs 0.6 µs where one is a structure. The code does
    not check them: call it with the same structure, and with arrays of the same type and layout.

    Args:
        kernel: compiled.
        arguments: of a call.
    """
    kernel(*arguments)
    if config.DISABLE_JIT:
        return cast(Callable[..., Any], kernel)
    code = kernel.overloads.get(tuple(typeof(argument) for argument in arguments))
    return cast(Callable[..., Any], getattr(code, "entry_point", kernel))


def address(kernel: Any, *arguments: Any) -> Any:
    """Return the address of a kernel's code for the types of some arguments, which it is not called with.

    A loop of kernels calls them by their addresses, and so is compiled without compiling them into it once more, which
    takes as long again as each of them did. With `NUMBA_DISABLE_JIT=1` an address is the kernel itself.
    """
    if config.DISABLE_JIT:
        return kernel
    kinds = tuple(typeof(argument) for argument in arguments)
    kernel.compile(kinds)
    code = kernel.overloads[kinds]
    return code.library.get_pointer_to_function(code.fndesc.llvm_func_name)


def _caller(result: Any) -> Callable[..., Any]:
    """Return what calls, in compiled code, a kernel by its address with a tuple of arguments.

    Types are not checked: the arguments have to be of the types that the address was asked for.

    Args:
        result: type of what the kernel returns.
    """
    if config.DISABLE_JIT:
        return lambda kernel, arguments: kernel(*arguments)

    @intrinsic
    def call(_: Any, address: Any, arguments: Any) -> Any:
        def write(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            kinds = tuple(signature.args[1])
            function = context.call_conv.get_function_type(signature.return_type, kinds)
            code = builder.inttoptr(values[0], function.as_pointer())
            given = cgutils.unpack_tuple(builder, values[1])
            status, answer = context.call_conv.call_function(builder, code, signature.return_type, kinds, given)
            with cgutils.if_unlikely(builder, status.is_error):
                context.call_conv.return_status_propagate(builder, status)
            return answer

        return result(address, types.Tuple([types.unliteral(kind) for kind in arguments])), write

    return cast(Callable[..., Any], call)


call = _caller(types.none)
"""Call a kernel that returns nothing: address, tuple of arguments."""
call_for_code = _caller(types.intp)
"""Call one that returns an integer."""
call_for_truth = _caller(types.boolean)
"""Call one that returns a truth value."""
call_for_three_counts = _caller(types.UniTuple(types.intp, 3))
"""Call one that returns three integers."""
call_for_placing = _caller(types.Tuple((types.intp, types.boolean)))
"""Call one that returns an integer and a truth value, as `place_obstacles`."""
call_for_nearness = _caller(types.Tuple((types.boolean, types.float64)))
"""Call one that returns a truth value and a number, as `comes_near`."""
