"""Private hooks of numba that halve compile times: a part is optimised in its callers only."""

from typing import Any

from numba._dynfunc import make_function
from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags


class KernelLibrary(JITCodeLibrary):
    """Instructions, optimised when all that they call stands beside them; those of a part wait for a caller."""

    is_part: bool

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        if not self.is_part:
            passes, builder = self._codegen._module_pass_manager()
            passes.run(self._final_module, builder)

    def _finalize_final_module(self) -> None:
        finalise: Any = self._finalize_dynamic_globals if self.is_part else super()._finalize_final_module
        finalise()
        self._finalized = True


class KernelFlags(Flags):  # numba looks options up for every operation that it types
    """Options that are compared by what was set of them."""

    __hash__ = lambda self: hash(tuple(self._values))  # noqa: E731
    __eq__ = lambda self, other: self._values == other._values  # noqa: E731


class Kernel(CompilerBase):
    """The pipeline of a function that Python calls; `Part` is that of one that only compiled functions call."""

    is_part = False

    def define_pipelines(self) -> Any:
        """numba's own, into a library of ours."""
        library: Any = KernelLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)  # type: ignore[no-untyped-call]
        self.state.library, library.is_part = library, self.is_part
        library.enable_object_caching()
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]

    def _compile_core(self) -> Any:
        self.state.flags, self.state.flags.no_compile = KernelFlags(self.state.flags), self.is_part  # type: ignore[no-untyped-call]
        made = super()._compile_core()  # type: ignore[no-untyped-call]
        if self.is_part:
            desc, libraries = made.fndesc, (made.library,)
            key = make_function(desc.lookup_module(), desc.qualname, "", 0, made.environment, libraries)
            made.target_context.insert_user_function(key, desc, libraries)
            made = made._replace(entry_point=key)
        return made


Part: Any = type("Part", (Kernel,), {"is_part": True})


def for_any_number(part: Any) -> None:
    """Compile a part once for all integers and truth values, not once more for each constant that a caller gives."""
    typed = part.get_call_template
    part.get_call_template = lambda args, kws: typed(tuple(map(types.unliteral, args)), kws)
