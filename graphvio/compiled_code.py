"""How numba stores and loads the code of kernels.

With machine code numba stores intermediate code, for kernels that call this one and are compiled later, and parses it
whenever it loads the former. That is half of the time and of the memory that loading takes, and as a rule for nothing.
Here it is parsed when such a kernel is compiled.
"""

from typing import Any, ClassVar

import llvmlite.binding as llvm
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.codegen import JITCodeLibrary

from graphvio.kernel_cache import cache_folders

_STAMP = ""  # numba's own check of the source, which the name of the folder replaces


class KernelCache(FunctionCache):  # type: ignore[misc]
    """The compiled code of one kernel, in the folders of `cache_folders`."""

    def __init__(self, function: Any) -> None:
        self._impl_class = _Implementation
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


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Loads machine code, and keeps the intermediate code as bytes."""

    _locator_classes: ClassVar = [_Locator]

    def rebuild(self, target_context: Any, stored: Any) -> Any:
        library_state, description, *others = stored
        name, kind, (machine_code, intermediate_code) = library_state
        # numba asks these names from the intermediate code
        target_context.codegen()._engine._defined_symbols |= {
            description.llvm_func_name, description.llvm_cpython_wrapper_name, description.env_name,
        }  # fmt: skip
        nothing = llvm.parse_assembly("").as_bitcode()
        result = super().rebuild(target_context, ((name, kind, (machine_code, nothing)), description, *others))
        result.library._shared_module = None
        result.library._intermediate_code = intermediate_code
        result.library.__class__ = _LoadedLibrary
        return result


class _LoadedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code that was loaded."""

    _shared_module: Any

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = llvm.parse_bitcode(self._intermediate_code)
        return self._shared_module
