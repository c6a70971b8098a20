"""Worker processes that end when the process that started them does."""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import lru_cache


@lru_cache
def leave_with(parent: int) -> None:
    """End this process when its parent, by process id, does: Ctrl-C is for that one, and a kill leaves no orphan."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    if os.getppid() == parent:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=watch, daemon=True).start()
