"""Commands in a process of their own."""

import subprocess
from typing import Any


def ran(command: Any, **more: Any) -> subprocess.CompletedProcess[str]:
    """What a command printed and returned; options as of `subprocess.run`."""
    return subprocess.run(command, capture_output=True, text=True, **more)
