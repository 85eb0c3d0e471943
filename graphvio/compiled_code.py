"""How numba compiles kernels, and how their code is stored and loaded.

A kernel that Python calls needs machine code and a wrapper. One that another kernel calls becomes part of that one, as
intermediate code, so that machine code and wrapper of its own would never run. numba makes all of it for every kernel;
here each is made where it is needed. The few kernels that both Python and kernels call are compiled twice for that.
"""

import functools
from typing import Any, ClassVar

import llvmlite.binding as llvm
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_machinery import register_pass
from numba.core.cpu_options import FastMathOptions
from numba.core.fastmathpass import rewrite_module
from numba.core.lowering import Lower
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

from graphvio.kernel_cache import cache_folders
from graphvio.reference_counts import remove_reference_counts

_STAMP = ""  # numba's own check of the source, which the name of the folder replaces
_OPTIONS = {
    "nopython": True,
    "nogil": True,
    "error_model": "numpy",
    # What a kernel calls becomes part of it. Else the linker takes whichever copy of the callee it met first, and these
    # differ by how often they were optimised: the run that compiles would not give what later ones give.
    "forceinline": True,
    "no_cfunc_wrapper": True,
    "no_cpython_wrapper": True,  # an `_EntryLibrary` gets its own
}
_NOTHING = llvm.parse_assembly("").as_bitcode()


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A function that is compiled when Python calls it; kernels that call it take it as an `InlinedKernel`.

    Args:
        function: the function.
        fast_math: LLVM's fast-math flags of its arithmetic, such as ``{"reassoc", "contract"}``; ``{"fast"}`` is all.
    """

    def __init__(self, function: Any, fast_math: frozenset[str] = frozenset()) -> None:
        super().__init__(function, targetoptions=_OPTIONS, pipeline_class=_compiler(_EntryLibrary, fast_math))
        self._cache = _Cache(function)
        self._fast_math = fast_math

    @functools.cached_property
    def _inlined(self) -> "InlinedKernel":
        return InlinedKernel(self.py_func, self._fast_math)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the signature of a call from a kernel."""
        return self._inlined.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the key of the code that a kernel takes."""
        return self._inlined.get_overload(sig)


class InlinedKernel(CPUDispatcher):  # type: ignore[misc]
    """A kernel as other kernels take it: intermediate code that has no address."""

    def __init__(self, function: Any, fast_math: frozenset[str]) -> None:
        super().__init__(function, targetoptions=_OPTIONS, pipeline_class=_compiler(_InlinedLibrary, fast_math))
        self._cache = _InlinedCache(function)

    def add_overload(self, cres: CompileResult) -> None:
        """Make compiled or loaded code known to kernels that call it."""
        if cres.entry_point is None:
            cres = cres._replace(entry_point=_key())
            self.targetctx.insert_user_function(cres.entry_point, cres.fndesc, [cres.library])
        self.overloads[tuple(cres.signature.args)] = cres


def _key() -> object:
    """Return something by which numba finds code that has no address."""
    return object()


class _EntryLibrary(JITCodeLibrary):  # type: ignore[misc]
    """The machine code of a kernel that Python calls."""

    def make_callable(self, state: Any) -> None:
        """Add the wrapper by which Python calls it, and compile both."""
        context, lowered = state.targetctx, state["cr"]
        with context.push_code_library(self):
            context.create_cpython_wrapper(
                self, lowered.fndesc, lowered.env, lowered.call_helper, state.flags.release_gil
            )
        function = context.get_executable(self, lowered.fndesc, lowered.env)
        state["cr"] = lowered._replace(cfunc=function)

    def serialize_using_object_code(self) -> Any:
        """Return the machine code; numba adds the intermediate code, which nobody needs here."""
        self._ensure_finalized()
        return self.name, "object", (self._get_compiled_object(), _NOTHING)


class _InlinedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Intermediate code of a kernel."""

    def make_callable(self, state: Any) -> None:
        """Leave it as it is, since Python does not call it."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def serialize_using_object_code(self) -> Any:
        """Return the intermediate code."""
        return self.name, "bitcode", self._get_module_for_linking().as_bitcode()

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> "_InlinedLibrary":
        name, _, intermediate_code = state
        library = cls(codegen, name)
        library._shared_module = llvm.parse_bitcode(intermediate_code)
        library._finalized = True
        return library


@functools.cache
def _compiler(library: type[JITCodeLibrary], fast_math: frozenset[str]) -> type[Compiler]:
    """Return numba's compiler with another library, and with fast arithmetic that is confined to the kernel itself.

    The option ``fastmath`` of numba also reaches what a kernel uses of numba's own library (``x ** 2``, ``np.isnan``,
    ...), and numba compiles that once for all kernels of a process, in the mode of whichever asked for it first. A
    kernel's arithmetic then depends on the order of compilation, and one that has to find NaN may lose the check. Here
    the mode is that of a kernel's own instructions; what it uses of numba's library keeps IEEE arithmetic.
    """
    options = FastMathOptions(set(fast_math))

    class _Lower(Lower):  # type: ignore[misc]
        def lower_normal_function(self, fndesc: Any) -> None:
            super().lower_normal_function(fndesc)
            remove_reference_counts(self.module)
            if fast_math:
                rewrite_module(self.module, options)

    @register_pass(mutates_CFG=True, analysis_only=False)
    class _Lowering(NativeLowering):  # type: ignore[misc]
        _name = "native_lowering_" + "_".join([library.__name__, *sorted(fast_math)])

        @property
        def lowering_class(self) -> type[Lower]:
            return _Lower

        def run_pass(self, state: Any) -> bool:
            state.library = library(state.targetctx.codegen(), state.func_id.func_qualname)
            state.library.enable_object_caching()
            state.flags.no_compile = True  # to machine code, which `make_callable` does where it is needed
            super().run_pass(state)
            state.library.make_callable(state)
            return True

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


class _Locator(_CacheLocator):  # type: ignore[misc]
    """Where the code of a kernel is."""

    def __init__(self, function: Any) -> None:
        self._folder = str(cache_folders(function.__module__)[0])
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, file: str) -> "_Locator":
        return cls(function)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return _STAMP

    def get_disambiguator(self) -> str:
        return str(self._line)


class _EntryImplementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Loads machine code."""

    _locator_classes: ClassVar = [_Locator]

    def rebuild(self, target_context: Any, stored: Any) -> CompileResult:
        """Return the kernel of what was stored."""
        description = stored[1]
        # numba asks these names from the intermediate code
        target_context.codegen()._engine._defined_symbols |= {
            description.llvm_cpython_wrapper_name, description.env_name,
        }  # fmt: skip
        return super().rebuild(target_context, stored)


class _InlinedImplementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Loads intermediate code."""

    _locator_classes: ClassVar = [_Locator]

    def rebuild(self, target_context: Any, stored: Any) -> CompileResult:
        """Return the kernel of what was stored."""
        library, description, environment, signature, objectmode, lifted, annotation, reload_init, referenced = stored
        return CompileResult(
            typing_context=target_context.typing_context,
            target_context=target_context,
            entry_point=_key(),
            typing_error=None,
            type_annotation=annotation,
            signature=signature,
            objectmode=objectmode,
            lifted=lifted,
            fndesc=description,
            library=_InlinedLibrary._unserialize(target_context.codegen(), library),
            call_helper=None,
            environment=environment,
            metadata=None,
            reload_init=reload_init,
            referenced_envs=referenced,
        )


class _Cache(FunctionCache):  # type: ignore[misc]
    """The compiled code of one kernel, in the folders of `cache_folders`."""

    _impl_class = _EntryImplementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._shared = [
            IndexDataCacheFile(str(folder), self._impl.filename_base, _STAMP)
            for folder in cache_folders(function.__module__)[1:]
        ]

    def _load_overload(self, signature: Any, target_context: Any) -> Any:
        found = super()._load_overload(signature, target_context)
        key = self._index_key(signature, target_context.codegen())
        for file in self._shared:
            if found is None and (stored := file.load(key)) is not None:
                found = self._impl.rebuild(target_context, stored)
        return found


class _InlinedCache(_Cache):
    """The same of a kernel as other kernels take it."""

    _impl_class = _InlinedImplementation

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        return "inlined", *super()._index_key(signature, codegen)
