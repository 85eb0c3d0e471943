"""Kernels without reference counts, where none are needed.

numba increments and decrements a counter whenever a kernel takes an array out of a tuple, or a row of a matrix: a call
and an atomic instruction each, in loops that are a few instructions long. Arguments are kept alive by the caller, so
that a kernel that neither allocates nor returns arrays, nor stores one in a list or an object, needs no counting.
Kernels store arrays in no such thing here.

This reads the intermediate code that numba makes. Were it to change in a way that this does not see, arrays would be
freed too soon; kernels of versions of numba that the tests have not been run with therefore keep their counts.
"""

import numba
from llvmlite import ir

_TESTED = ((0, 61), (0, 68))  # first and last version
_COUNTS = frozenset({"NRT_incref", "NRT_decref"})


def remove_reference_counts(module: ir.Module) -> None:
    """Remove the reference counts of a kernel that owns no arrays; one that may own some is left unchanged.

    Args:
        module: with the kernel as numba has lowered it, and declarations of what it calls.
    """
    if not _TESTED[0] <= numba.version_info.short <= _TESTED[1]:
        return
    blocks = [block for function in module.functions for block in function.blocks]
    calls = [each for block in blocks for each in block.instructions if isinstance(each, ir.CallInstr)]
    functions = [function for function in module.functions if function.blocks]
    if any(map(_returns_array, functions)) or any(_may_own(call.callee) for call in calls):
        return
    for block in blocks:
        block.instructions = [each for each in block.instructions if not _is_count(each)]


def _is_count(instruction: ir.Instruction) -> bool:
    return isinstance(instruction, ir.CallInstr) and instruction.callee.name in _COUNTS


def _may_own(callee: ir.Function) -> bool:
    """Return whether a function allocates memory, or returns an array, which is the caller's then."""
    if callee.name in _COUNTS:
        return False
    return callee.name.startswith("NRT_") or "_call_allocator" in callee.name or _returns_array(callee)


def _returns_array(function: ir.Function) -> bool:
    """Return whether a function's result, which numba's write to where their first argument points, has pointers."""
    arguments = function.function_type.args
    if not arguments or not isinstance(arguments[0], ir.PointerType):
        return False
    result = arguments[0].pointee
    return isinstance(result, ir.types.Aggregate) and _has_pointer(result)


def _has_pointer(kind: ir.Type) -> bool:
    if isinstance(kind, ir.types.Aggregate):
        return any(_has_pointer(each) for each in kind.elements)
    return isinstance(kind, ir.PointerType)
