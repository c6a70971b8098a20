"""What can be wrong with a table or figure before there is a number to show."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..file_names import file_name
from ..plugins import suggestion

if TYPE_CHECKING:
    from .study import Study

NAMES = ("rows", "columns", "x", "by")
"""Arguments of the views of this package that name columns of the results."""
ALWAYS = ("run", "ego", "method", "status", "seconds", "reason")


def check_views(study: Study) -> None:
    """Refuse views that cannot be made, before the first cell is computed rather than after the last.

    Raises:
        InputError: a name that is no file name, a view that cannot be called with the results alone, or a column that
            is nearly, and not quite, the name of an axis or setting.
    """
    for kind, found in (("tables", study.tables), ("figures", study.figures)):
        for name, view in found.items():
            file_name(kind, name, "Rename it: its file has this name.")
            where = f"{kind}[{name!r}]"
            _callable(where, view)
            if isinstance(view, partial):
                _columns(
                    where, inspect.signature(view.func), view, (*study.axes, *study.settings, *study.metrics, *ALWAYS)
                )


def _callable(where: str, view: Callable[..., Any]) -> None:
    try:
        inspect.signature(view).bind(object())
    except (TypeError, ValueError) as error:
        hint = "Give functools.partial(view, name=...) with the names of the view's own arguments."
        raise InputError(where, str(error), "must be a function of the Results alone", hint) from None


def _columns(where: str, signature: inspect.Signature, view: partial[Any], known: tuple[str, ...]) -> None:
    given = {**signature.bind_partial(None, *view.args).arguments, **view.keywords} if view.args else view.keywords
    for field in (*NAMES, "where"):
        value = given.get(field)
        named = value if isinstance(value, dict | list | tuple) else [value]
        for column in (name for name in named if isinstance(name, str) and name not in known):
            if near := suggestion(column, known, ""):
                allowed = f"must be a column of the results, such as {', '.join(known[:8])}"
                raise InputError(f"{where}: {field}", repr(column), allowed, near)
