"""Compile a table as a paper would; skips, and says why, where there is no LaTeX with booktabs."""

import shutil
import subprocess

import pytest
from shell import ran


def compiled(tables, folder):
    """What pdflatex says about a page with these tables; t.pdf is in the folder."""
    if shutil.which("pdflatex") is None:
        pytest.skip("pdflatex is not installed: apt-get install texlive-latex-base texlive-latex-recommended")
    if subprocess.run(["kpsewhich", "booktabs.sty"], capture_output=True).returncode:
        pytest.skip("LaTeX has no booktabs: apt-get install texlive-latex-recommended")
    source = r"\documentclass{article}\usepackage{booktabs,graphicx}\begin{document}" + tables + r"\end{document}"
    (folder / "t.tex").write_text(source)
    done = ran(["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"], cwd=folder, timeout=60)
    assert done.returncode == 0, done.stdout[-2000:]
    return done.stdout
