"""Private hooks of numba that halve compile times: a part is optimised once, in the machine code of its callers.

numba would optimise each part alone, and once more at each level of calls above it, and make machine code of it that
nothing runs. Where a name is missing `compile` uses plain `njit`.
"""

from functools import partial
from typing import Any

from numba import config
from numba._dynfunc import make_function
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import NativeLowering


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
    """Translate a part and make it known to its callers, without the branch for an exception: it raises none."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        """Leave the result in `state.cr`."""
        state.flags.no_compile = True
        super().run_pass(state)  # type: ignore[no-untyped-call]
        desc, libraries = state.cr.fndesc, (state.library,)
        key = make_function(desc.lookup_module(), desc.qualname, "", 0, state.cr.env, libraries)
        state.targetctx.insert_user_function(key, desc, libraries)
        state.cr = state.cr._replace(cfunc=key)
        return True


class Kernel(CompilerBase):
    """The pipeline of a function that Python calls."""

    library: type[KernelLibrary] = KernelLibrary

    def define_pipelines(self) -> list[PassManager]:
        """numba's passes, into a library of ours."""
        self.state.library = self.library(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


class Part(Kernel):
    """The pipeline of a function that only compiled ones call."""

    library = PartLibrary

    def define_pipelines(self) -> list[PassManager]:
        """The same passes, with `PartLowering`."""
        (passes,) = super().define_pipelines()
        passes.passes[:] = [(PartLowering if each is NativeLowering else each, why) for each, why in passes.passes]
        passes.finalize()
        return [passes]
