"""Wheels with the machine code of every kernel: one for each CPython, on Linux x86-64.

    python .ci/wheels.py dist python3.11 python3.12 python3.13

Beside the wheel of Python alone in the folder, which serves every other machine and compiles. Each interpreter gets an
environment in build/wheels with the pinned packages; numba and llvmlite are pinned in the wheel, too, as machine code
of one version is of no use to another.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PLATFORM = "manylinux_2_27_x86_64"
"""That of llvmlite's own wheels."""
ROOT = Path(__file__).resolve().parents[1]


def run(*command: object) -> None:
    """Run a command; its failure is ours."""
    subprocess.run([str(word) for word in command], check=True, cwd=ROOT)


def environment(interpreter: str, pure: Path) -> Path:
    """Python of an environment with the wheel and what it needs, pinned."""
    python = ROOT / "build" / "wheels" / interpreter.replace("/", "_") / "bin" / "python"
    if not python.exists():
        run(interpreter, "-m", "venv", python.parents[1])
    install = python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-c", "constraints.txt"
    run(*install, "torch")
    run(*install, f"{pure}[learned]")
    run(*install, "--no-deps", "--force-reinstall", pure)
    return python


def pinned(metadata: str, versions: dict[str, str]) -> str:
    """Metadata that ask for exactly these versions, in place of a range of numba's."""
    lines = "".join(f"Requires-Dist: {name}=={versions[name]}\n" for name in ("numba", "llvmlite"))
    made, count = re.subn(r"^Requires-Dist: numba[^;\n]*\n", lines, metadata, flags=re.MULTILINE)
    if count != 1:
        sys.exit("METADATA names numba's range not once")
    return made


def pack(pure: Path, code: Path, interpreter: Path, out: Path) -> None:
    """Write the wheel of an interpreter: the pure one with the machine code in it."""
    about = "import json, sys; print('cp{}{}'.format(*sys.version_info))"
    tag = subprocess.run([interpreter, "-c", about], check=True, capture_output=True, text=True).stdout.strip()
    versions = dict(re.findall(r'"(\w+)": "([^"]+)"', (code / "about.json").read_text()))
    with tempfile.TemporaryDirectory() as folder:
        run(sys.executable, "-m", "wheel", "unpack", "--dest", folder, pure)
        (whole,) = Path(folder).iterdir()
        shutil.copytree(code, whole / "coopoc" / "kernels" / "shipped")
        (facts,) = whole.glob("*.dist-info")
        metadata, wheel = facts / "METADATA", facts / "WHEEL"
        metadata.write_text(pinned(metadata.read_text(), versions))
        text = wheel.read_text().replace("Root-Is-Purelib: true", "Root-Is-Purelib: false")
        wheel.write_text(text.replace("Tag: py3-none-any", f"Tag: {tag}-{tag}-{PLATFORM}"))
        run(sys.executable, "-m", "wheel", "pack", "--dest-dir", out, whole)


def main(folder: str, *interpreters: str) -> None:
    """Write the wheels into the folder of the pure one."""
    out = Path(folder).resolve()
    (pure,) = out.glob("*-py3-none-any.whl")
    for interpreter in interpreters:
        python = environment(interpreter, pure)
        code = python.parents[1] / "machine_code"
        run(python, ROOT / "benchmarks" / "compile.py", "--into", code)
        pack(pure, code, python, out)


if __name__ == "__main__":
    main(*sys.argv[1:])
