"""How numba compiles kernels and their parts.

A part is typed and translated once, and optimised in the machine code of its callers only. numba would optimise it
alone, too, and once more at each level of calls above it, and make machine code that nothing ever runs.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from numba import config
from numba._dynfunc import make_function
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.imputils import fix_returning_optional
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
"""Passes for what no part contains: `with`, exceptions, closures, loops over tuples of mixed types, sums of arrays."""


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


def _call(part: Any, context: Any, build: Any, signature: Any, args: Any) -> Any:
    """Call a part, without the branch that passes an exception on: it raises none."""
    function = context.declare_function(build.module, part)
    status, found = context.call_conv.call_function(build, function, part.restype, part.argtypes, args)
    return fix_returning_optional(context, build, signature, status, found)


@register_pass(mutates_CFG=True, analysis_only=False)
class PartLowering(NativeLowering):
    """Translates a part, and makes it known to its callers."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        """Leave the result in `state.cr`."""
        state.flags.no_compile = True
        super().run_pass(state)  # type: ignore[no-untyped-call]
        found, context = state.cr, state.targetctx
        key = make_function(found.fndesc.lookup_module(), found.fndesc.qualname, "", 0, found.env, (state.library,))
        if config.BOUNDSCHECK:  # type: ignore[attr-defined]
            context.insert_user_function(key, found.fndesc, [state.library])
        else:
            call: Any = partial(_call, found.fndesc)
            call.signature, call.libs = found.fndesc.argtypes, (state.library,)
            context._defns[key].append(call, call.signature)
        state.cr = found._replace(cfunc=key)
        return True


class KernelFlags(Flags):
    """Options that are compared by what was set of them: numba looks them up for every operation that it types."""

    def __hash__(self) -> int:
        return hash(tuple(self._values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KernelFlags) and self._values == other._values


class Kernel(CompilerBase):
    """How a function that Python calls is compiled."""

    library: type[KernelLibrary] = KernelLibrary

    def _compile_core(self) -> Any:
        self.state.flags = KernelFlags(self.state.flags)  # type: ignore[no-untyped-call]
        return super()._compile_core()  # type: ignore[no-untyped-call]

    def define_pipelines(self) -> list[PassManager]:
        """numba's passes, into a library of ours."""
        self.state.library = self.library(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


class Part(Kernel):
    """How a function that only compiled ones call is compiled."""

    library = PartLibrary

    def define_pipelines(self) -> list[PassManager]:
        """The passes that a part needs, each once."""
        (whole,), passes = super().define_pipelines(), PassManager("part")
        for each, why in dict(reversed(whole.passes)).items():
            if each not in UNUSED:
                passes.passes.insert(0, (PartLowering if each is NativeLowering else each, why))
        passes.finalize()
        return [passes]
