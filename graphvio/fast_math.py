"""Fast floating-point arithmetic that is confined to the kernels that ask for it.

The option ``fastmath`` of numba also reaches what a kernel uses of numba's own library (``x ** 2``, ``np.isnan``, ...),
and numba compiles that once for all kernels of a process, in the mode of whichever asked for it first. A kernel's
arithmetic then depends on the order of compilation, and one that has to find NaN may lose the check. Here the mode is
that of a kernel's own instructions; what it uses of numba's library keeps IEEE arithmetic.
"""

from typing import Any

from numba.core.compiler import Compiler
from numba.core.compiler_machinery import register_pass
from numba.core.cpu_options import FastMathOptions
from numba.core.fastmathpass import rewrite_module
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering


def fast_math_compiler(flags: frozenset[str]) -> type[Compiler]:
    """Return the compiler, for the ``pipeline_class`` of ``numba.njit``, of kernels with these fast-math flags.

    Args:
        flags: LLVM's fast-math flags, such as ``{"reassoc", "contract"}``, or ``{"fast"}`` for all.
    """
    options = FastMathOptions(set(flags))

    class _Lower(Lower):  # type: ignore[misc]
        def lower_normal_function(self, fndesc: Any) -> None:
            super().lower_normal_function(fndesc)
            rewrite_module(self.module, options)

    @register_pass(mutates_CFG=True, analysis_only=False)
    class _Lowering(NativeLowering):  # type: ignore[misc]
        _name = "native_lowering_" + "_".join(sorted(flags))

        @property
        def lowering_class(self) -> type[Lower]:
            return _Lower

    class _Compiler(Compiler):  # type: ignore[misc]
        def define_pipelines(self) -> list[Any]:
            pipelines: list[Any] = super().define_pipelines()
            for pipeline in pipelines:
                pipeline.passes = [
                    (_Lowering if each is NativeLowering else each, why) for each, why in pipeline.passes
                ]
                pipeline.finalize()
            return pipelines

    return _Compiler
