"""The passes that make a kernel of a function: numba's own, less those for what no kernel contains.

A part is typed and translated once, and optimised in the machine code of its callers only. numba would optimise it
alone, too, and once more at each level of calls above it, and make machine code that nothing ever runs.
"""

from __future__ import annotations

from typing import Any

from numba._dynfunc import make_function
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import InlineOverloads, NativeLowering, NopythonRewrites
from numba.core.untyped_passes import (
    FindLiterallyCalls,
    InlineClosureLikes,
    LiteralPropagationSubPipelinePass,
    LiteralUnroll,
    MakeFunctionToJitFunction,
    RewriteDynamicRaises,
    WithLifting,
)

UNUSED = {
    WithLifting,
    RewriteDynamicRaises,
    MakeFunctionToJitFunction,
    FindLiterallyCalls,
    InlineClosureLikes,
    LiteralUnroll,
    LiteralPropagationSubPipelinePass,
    InlineOverloads,
    NopythonRewrites,
}
"""Passes for `with`, exceptions made at run time, closures, and loops over tuples of several types."""


class KernelLibrary(JITCodeLibrary):
    """Instructions that are optimised once, when everything that they call stands beside them."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


class PartLibrary(KernelLibrary):
    """Instructions that wait for a caller: neither optimised nor made machine code."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class PartLowering(NativeLowering):
    """Translates a part, and makes it known to its callers."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        """Leave the result in `state.cr`."""
        state.flags.no_compile = True
        super().run_pass(state)  # type: ignore[no-untyped-call]
        found, name = state.cr, state.func_id.func_name
        never = make_function(found.fndesc.lookup_module(), name, "", 0, found.env, (state.library,))
        state.targetctx.insert_user_function(never, found.fndesc, [state.library])
        state.cr = found._replace(cfunc=never)
        return True


class KernelFlags(Flags):
    """Options that are compared by what was set of them: numba looks them up for every operation that it types."""

    def __hash__(self) -> int:
        return hash(tuple(self._values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KernelFlags) and self._values == other._values


class Kernel(CompilerBase):
    """How a function that Python calls is compiled."""

    library: type = KernelLibrary
    lowering: type = NativeLowering

    def _compile_core(self) -> Any:
        self.state.flags = KernelFlags(self.state.flags)  # type: ignore[no-untyped-call]
        return super()._compile_core()  # type: ignore[no-untyped-call]

    def define_pipelines(self) -> list[PassManager]:
        """The passes, each once."""
        self.state.library = self.library(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        passes = PassManager("kernel")
        for each, why in dict(reversed(DefaultPassBuilder.define_nopython_pipeline(self.state).passes)).items():
            if each not in UNUSED:
                passes.passes.insert(0, (self.lowering if each is NativeLowering else each, why))
        passes.finalize()
        return [passes]


class Part(Kernel):
    """How a function that only compiled ones call is compiled."""

    library = PartLibrary
    lowering = PartLowering
