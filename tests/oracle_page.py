"""docs/oracles.md from the tests themselves: their independent references and tolerances.

python tests/oracle_page.py        # writes the page; tests/test_reliability.py holds that it is current
"""

import ast
import re
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
HEAD = """# Independent references

Which numbers are checked against software that is not ours? Each row is a test file with its tests that name an
independent reference, and the tolerances of their assertions (without one, a test has a bound or an interval).
`tests/oracles` holds a dense textbook implementation of every method, and `tests/test_paper_scenario.py` reproduces
the README's table without the toolkit. `python tests/oracle_page.py` writes this page.

"""


def rows():
    """File and tests, with reference and tolerances, of every file with an independent reference."""
    for file in sorted(TESTS.glob("test_*.py")):
        text, tests = file.read_text(), []
        for node in ast.parse(text).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                words = " ".join((ast.get_docstring(node) or "").split())
                named = [name for name, pattern in REFERENCES.items() if re.search(pattern, words, re.IGNORECASE)]
                limits = dict.fromkeys(TOLERANCE.findall(ast.get_source_segment(text, node) or ""))
                held = ": ".join(", ".join(part) for part in (named, limits) if part)
                tests += [f"`{node.name.removeprefix('test_')}` ({held})"] * bool(named)
        if tests:
            yield file.stem, "; ".join(tests)


def page():
    """The whole page."""
    lines = ["| file | tests, with reference and tolerances |", "|---|---|"]
    return HEAD + "\n".join([*lines, *(f"| `{file}` | {tests} |" for file, tests in rows())]) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
