"""A tutorial of cells (`# %%`) as a page, with what its code prints, shows and draws, and as a Jupyter notebook."""

import ast
import contextlib
import io
import re
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

CELL = re.compile(r"^# %%(.*)\n", flags=re.MULTILINE)
LINE_OF_TEXT = re.compile(r"^# ?", flags=re.MULTILINE)


def page(source: str, name: str) -> tuple[str, dict[str, bytes]]:
    """The Markdown of a tutorial, and its pictures by file name.

    All cells run in one namespace of this process, so that libraries and compiled kernels are loaded once.

    >>> print(page("# %% [markdown]\\n# A sum.\\n\\n# %%\\n1 + 1", "sum")[0])
    A sum.
    <BLANKLINE>
    ```python
    1 + 1
    ```
    <BLANKLINE>
    ```text
    2
    ```
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    parts, pictures = [], dict[str, bytes]()
    _, *cells = CELL.split(source)
    for kind, text in zip(cells[::2], map(str.strip, cells[1::2]), strict=True):
        if "markdown" in kind:
            parts.append(LINE_OF_TEXT.sub("", text))
            continue
        parts.append(f"```python\n{text}\n```")
        printed, shown, figures = _run(text, names)
        for said in filter(None, (printed, shown if isinstance(shown, str) else "")):
            parts.append(f"```text\n{said.rstrip()}\n```")
        if hasattr(shown, "to_markdown"):
            parts.append(shown.to_markdown(index=False))
        for figure in figures:
            pictures[file := f"{name}-{len(pictures) + 1}.png"] = _png(figure)
            parts.append(f"![What the code above draws]({file})")
    return "\n\n".join(parts), pictures


def notebook(source: str) -> str:
    """The same cells as a notebook, without output: the JSON of a file .ipynb, valid and the same at each build.

    Raises:
        nbformat.ValidationError: no valid notebook.

    >>> import json
    >>> [cell["cell_type"] for cell in json.loads(notebook("# %% [markdown]\\n# A sum.\\n\\n# %%\\n1 + 1"))["cells"]]
    ['markdown', 'code']
    """
    import jupytext
    import nbformat

    made = jupytext.reads(source, fmt="py:percent")
    made.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    for number, cell in enumerate(made.cells):
        cell.id, cell.metadata = f"cell-{number}", {}
    nbformat.validate(made)
    return str(nbformat.writes(made))


def _run(text: str, names: dict[str, Any]) -> tuple[str, Any, list[Figure]]:
    """What a cell prints, the value of its last expression, and what it draws."""
    body, out, value = ast.parse(text).body, io.StringIO(), None
    last = body.pop() if isinstance(body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(out):
        exec(compile(ast.Module(body, []), "tutorial", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "tutorial", "eval"), names)
    figures = [plt.figure(number) for number in plt.get_fignums()]
    plt.close("all")
    if isinstance(value, Figure):
        return out.getvalue(), None, [*figures, value]
    return out.getvalue(), value if value is None or hasattr(value, "to_markdown") else repr(value), figures


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=130)
    return out.getvalue()
