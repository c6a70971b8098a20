"""The command `coopoc`, also `python -m coopoc`: Ctrl-C ends it without a traceback, even while libraries load."""

import atexit
import gc
import os
import sys
import threading
from contextlib import suppress


def main() -> None:
    """The console script: without a traceback where it is interrupted while libraries load.

    It ends without the destructors of C++ libraries: one whose thread still runs would call "terminate".
    """
    status: object = 130
    gc.set_threshold(100_000)  # a tenth of a short command is spent on collecting what libraries make while they load
    try:
        from .cli import main as command

        command()
    except SystemExit as ended:
        status = ended.code
    except KeyboardInterrupt:
        pass
    threading._shutdown()  # type: ignore[attr-defined]  # as Python does first: a thread that waits there ends the workers
    atexit._run_exitfuncs()
    with suppress(OSError, AttributeError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status if isinstance(status, int) else bool(status))


if __name__ == "__main__":
    main()
