"""Fuzz every reader, one after the other, and print a line for each; exit status 1 if there are finds.

PYTHONPATH=tests python -m fuzz.every --minutes 10
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from pathlib import Path

from .readers import READERS


def main() -> None:
    """Each reader in a process of its own, since libFuzzer ends its process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", default=list(READERS), help="default all")
    parser.add_argument("--minutes", type=float, default=10.0, help="for each reader (default 10)")
    parser.add_argument("--executions", type=int, default=1_000_000, help="after which a reader ends (default 10^6)")
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"), help="for inputs, finds and logs")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    failed = False
    for name in given.readers:
        ends = ["--minutes", str(given.minutes), "--executions", str(given.executions)]
        command = [sys.executable, "-m", "fuzz.run", name, *ends, "--out", str(given.out)]
        began = time.monotonic()
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        log = done.stdout + done.stderr
        (given.out / f"{name}.log").write_text(log)
        finds = re.findall(r"^FIND .*", log, re.MULTILINE)
        runs = re.search(r"number_of_executed_units: (\d+)", log)
        lines = re.findall(r"cov: (\d+)", log)
        covered = f"{int(lines[0])} -> {int(lines[-1])} edges" if lines else "no coverage"
        count, minutes = int(runs[1]) if runs else 0, (time.monotonic() - began) / 60
        rate = f"{count:,} executions in {minutes:.1f} min"
        print(f"{name}: {rate}, {covered}, {len(finds)} finds", flush=True)
        print("".join(f"  {find}\n" for find in finds), end="", flush=True)
        if done.returncode and not finds:
            print(f"  ended with {done.returncode}: {log[-500:]}", flush=True)
        failed |= bool(finds or done.returncode)
    sys.exit(failed)


if __name__ == "__main__":
    main()
