"""docs/oracles.md from the tests themselves: what was compared with what we did not write, and to which tolerance.

python tests/oracle_page.py        # writes the page; tests/test_reliability.py holds that it is current
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

TESTS, PAGE = Path(__file__).parent, Path(__file__).resolve().parents[1] / "docs" / "oracles.md"
REFERENCES = {
    "GTSAM": r"gtsam",
    "SciPy": r"scipy",
    "filterpy": r"filterpy",
    "Stone Soup": r"stone ?soup",
    "NumPy's lstsq": r"lstsq",
    "evo": r"\bevo('s)?\b",
    "CORA's published figures": r"\bCORA",
    "pandas": r"\bpandas",
    "pymap3d": r"pymap3d",
    "pynmeagps": r"pynmeagps",
    "PyTorch": r"\btorch",
    "ONNX Runtime": r"onnxruntime",
    "Flower": r"flower's|flwr",
    "dp_accounting": r"dp_accounting",
    "RFC test vectors": r"\bRFC\b",
    "NetworkX": r"networkx",
    "closed form": r"closed form|on paper|by hand",
    "brute force": r"brute force|restarts",
    "dense textbook oracle": r"dense oracle|\boracles\b",
    "published value": r"published",
}
TOLERANCE = re.compile(r"\b((?:atol|rtol|rel|abs)=[0-9][0-9.e+-]*)")
HEAD = """# What was compared with what we did not write

Generated from the tests by `python tests/oracle_page.py`. Each row is a test that names an independent reference in
its docstring; the tolerances are those of its assertions (where none stands, the test has a bound or an interval of its
own). `tests/oracles` holds a dense textbook implementation of every method, and `tests/test_paper_scenario.py`
reproduces the README's table by a simulation that shares no code with the toolkit.

"""


def rows() -> Iterator[tuple[str, str, str, str]]:
    """Subject, references, tolerances and test of every test with an independent reference."""
    for file in sorted(TESTS.glob("test_*.py")):
        text = file.read_text()
        tree = ast.parse(text)
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                words = " ".join((ast.get_docstring(node) or "").split())
                source = ast.get_source_segment(text, node) or ""
                references = [name for name, pattern in REFERENCES.items() if re.search(pattern, words, re.IGNORECASE)]
                if references:
                    tolerance = ", ".join(dict.fromkeys(TOLERANCE.findall(source))) or "its own"
                    subject = node.name.removeprefix("test_").replace("_", " ")
                    yield subject, ", ".join(references), tolerance, f"{file.stem}::{node.name}"


def page() -> str:
    """The whole page."""
    lines = ["| what | reference | tolerance | test |", "|---|---|---|---|"]
    lines += [f"| {what} | {reference} | {tolerance} | `{test}` |" for what, reference, tolerance, test in rows()]
    return HEAD + "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
