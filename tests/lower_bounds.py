"""Print the least version of each dependency as a constraint of pip: what `make test-lower` installs."""

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def lower(requirement):
    """The constraint of a requirement.

    >>> lower("scipy>=1.13"), lower("numba>=0.68,<0.69"), lower("numpy>=2")
    ('scipy==1.13.*', 'numba==0.68.*', 'numpy==2.0.*')
    """
    found = re.fullmatch(r"([\w.-]+)>=([\d.]+)(?:,<[\d.]+)?", requirement)
    assert found, f"{requirement} names no least version"
    name, version = found.groups()
    return f"{name}=={version}.*" if "." in version else f"{name}=={version}.0.*"


if __name__ == "__main__":
    project = tomllib.loads(PROJECT.read_text())
    print(*map(lower, [*project["project"]["dependencies"], *project["build-system"]["requires"]]), sep="\n")
