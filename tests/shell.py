"""Commands in a process of their own."""

import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))


def ran(command, **more: Any):
    """What a command printed and returned; options as of `subprocess.run`."""
    return subprocess.run(command, capture_output=True, text=True, **more)


def python(*words, **more: Any):
    """What Python printed with these words; fails with its complaint."""
    done = ran([sys.executable, *words], **more)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr
    return done.stdout
