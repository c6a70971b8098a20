"""Private hooks of numba that halve compile times: a part is optimised in its callers only."""

from typing import Any

from numba._dynfunc import make_function
from numba.core import types
from numba.core.codegen import CPUCodeLibrary, JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.typed_passes import NopythonRewrites
from numba.core.types.functions import BaseFunction
from numba.core.untyped_passes import InlineClosureLikes
from numba.extending import models, register_model
from numba.np import arrayobj


class KernelLibrary(JITCodeLibrary):
    """Instructions, optimised when all that they call stands beside them; those of a part wait for a caller."""

    is_part: bool

    def finalize(self) -> None:
        """Link what is called, and what that calls, once into what Python calls, and nothing into a part."""
        called, self._linking_libraries = self._linking_libraries, []
        if not self.is_part:
            _link(self._final_module, called)
        super().finalize()  # type: ignore[no-untyped-call]
        self._linking_libraries = called

    def _get_module_for_linking(self) -> Any:
        """What a function of numba's own links, such as an overload: a part with all that it calls."""
        module = super()._get_module_for_linking()  # type: ignore[no-untyped-call]
        if self.is_part:
            _link(module := module.clone(), self._linking_libraries)
        return module

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


def _link(module: Any, libraries: Any) -> None:
    """Link libraries, and those that wait in parts among them, each once."""
    found, left = set[Any](), [*libraries]
    while left:
        if (library := left.pop()) not in found:
            found.add(library)
            left += library._linking_libraries if getattr(library, "is_part", False) else []
            module.link_in(CPUCodeLibrary._get_module_for_linking(library), preserve=True)


class KernelFlags(Flags):  # numba looks options up for every operation that it types
    """Options that are compared by what was set of them."""

    __hash__ = lambda self: hash(tuple(self._values))  # noqa: E731
    __eq__ = lambda self, other: self._values == other._values  # noqa: E731


def _model(manager: Any, kind: Any) -> Any:
    """A NamedTuple of ours is one argument of a call, not one for each number that describes its arrays."""
    uniform = isinstance(kind, types.NamedUniTuple)
    model: Any = (models.UniTupleModel if uniform else models.TupleModel)(manager, kind)
    if kind.instance_class.__module__.startswith("coopoc."):
        model.get_argument_type = model.get_value_type
        model.as_argument = model.from_argument = lambda builder, value: value
    return model


register_model(types.NamedTuple)(_model)
register_model(types.NamedUniTuple)(_model)
Generic: Any = arrayobj.ol_raise_with_shape_context_generic
# Names no shapes where those of an assignment differ: to compile the text of numbers takes seconds.
arrayobj.ol_raise_with_shape_context_cpu.__code__ = Generic.__code__

UNUSED = InlineClosureLikes, NopythonRewrites
"""Passes for what no kernel has: closures, comprehensions and sums of whole arrays."""
Called: Any = BaseFunction
RESOLVE, KNOWN = Called.get_call_type, dict[Any, Any]()


def _known_call(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """The signature of a function of numba's own: it would try every implementation at each call."""
    key = self, args, *kws.items()
    if key not in KNOWN:
        KNOWN[key] = RESOLVE(self, context, args, kws)
    return KNOWN[key]


class Kernel(CompilerBase):
    """The pipeline of a function that Python calls; `Part` is that of one that only compiled functions call."""

    is_part = False

    def define_pipelines(self) -> Any:
        """numba's own, into a library of ours."""
        library: Any = KernelLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)  # type: ignore[no-untyped-call]
        self.state.library, library.is_part = library, self.is_part
        library.enable_object_caching()
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.passes = [each for each in manager.passes if each[0] not in UNUSED]
        manager.finalize()
        return [manager]

    def _compile_core(self) -> Any:
        self.state.flags, self.state.flags.no_compile = KernelFlags(self.state.flags), self.is_part  # type: ignore[no-untyped-call]
        resolve = Called.get_call_type
        Called.get_call_type = _known_call
        try:
            made = super()._compile_core()  # type: ignore[no-untyped-call]
        finally:
            Called.get_call_type = resolve
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
