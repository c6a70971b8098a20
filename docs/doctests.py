"""Doctests of docstrings as blocks of code on the site's pages."""

from typing import Any

import griffe


class Doctests(griffe.Extension):
    """Fences each paragraph that begins with a prompt."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Once for every module, class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = fenced(obj.docstring.value)


def fenced(text: str) -> str:
    """The text with doctests between fences.

    >>> fenced("Words.\\n\\n>>> 1 + 1\\n2")
    'Words.\\n\\n```pycon\\n>>> 1 + 1\\n2\\n```'
    """
    parts = text.split("\n\n")
    return "\n\n".join(f"```pycon\n{part}\n```" if part.startswith(">>>") else part for part in parts)
