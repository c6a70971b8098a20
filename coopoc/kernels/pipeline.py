"""The passes that make a kernel of a function: numba's own, less those for what no kernel contains.

A part is typed and translated once, and optimised in the machine code of its callers only. numba would optimise it
alone, too, and once more at each level of calls above it, and make machine code that nothing ever runs.
"""

from __future__ import annotations

from typing import Any

from numba import _dynfunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import InlineOverloads, NativeLowering, NoPythonBackend
from numba.core.untyped_passes import (
    FindLiterallyCalls,
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
    LiteralUnroll,
    LiteralPropagationSubPipelinePass,
    InlineOverloads,
}
"""Passes for `with`, exceptions made at run time, closures, and loops over tuples of several types."""


class Passes(PassManager):
    """Passes that are not checked one by one: to analyse the text anew after each takes longer than most of them."""

    _ENFORCING = False


class Kernel(CompilerBase):  # type: ignore[misc]
    """How a function that Python calls is compiled."""

    lowering: type = NativeLowering

    def define_pipelines(self) -> list[Passes]:
        """The passes."""
        passes = Passes("kernel")
        for each, why in DefaultPassBuilder.define_nopython_pipeline(self.state).passes:
            if each not in UNUSED:
                passes.add_pass(self.lowering if each is NativeLowering else each, why)
        passes.finalize()
        return [passes]


class PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Instructions that wait for a caller: neither optimised nor made machine code."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class PartLowering(NativeLowering):  # type: ignore[misc]
    """Translates a part, and makes it known to its callers."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        """Leave the result in `state.cr`."""
        state.library = PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        found, name = state.cr, state.func_id.func_name
        never = _dynfunc.make_function(found.fndesc.lookup_module(), name, "", 0, found.env, (state.library,))
        state.targetctx.insert_user_function(never, found.fndesc, [state.library])
        state.cr = found._replace(cfunc=never)
        return True


class Part(Kernel):
    """How a function that only compiled ones call is compiled."""

    lowering = PartLowering
