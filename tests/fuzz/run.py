"""Coverage-guided fuzzing of one reader with atheris; finds are written to a folder and do not end the run.

    PYTHONPATH=tests python -m fuzz.run g2o --minutes 10 --out fuzz-out

Prints the executions, the coverage of libFuzzer and one line per find. A find that is mended goes to the corpus, which
`tests/test_data_fuzz.py` reads again.
"""

import argparse
import hashlib
import re
import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["coopoc"], enable_loader_override=False):
    from fuzz.contract import verdict
    from fuzz.readers import READERS, packed
from fuzz.tokens import TOKENS

CORPUS = Path(__file__).parent / "corpus"


def main() -> None:
    """Fuzz until the time or the number of executions is over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reader", choices=READERS)
    parser.add_argument("--minutes", type=float, default=10.0, help="of fuzzing (default 10)")
    parser.add_argument("--executions", type=int, default=-1, help="after which it ends, too (default any number)")
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"), help="for inputs and finds")
    parser.add_argument("--longest", type=int, default=8192, help="bytes of an input (default 8192)")
    given = parser.parse_args()
    reader = READERS[given.reader]
    own = given.out.resolve() / given.reader.replace(" ", "-")
    inputs, finds = own / "inputs", own / "finds"
    for folder in (inputs, finds):
        folder.mkdir(parents=True, exist_ok=True)
    (inputs / "good").write_bytes(packed({name: text.encode() for name, text in reader.files.items()}))
    words = dict.fromkeys([*TOKENS, *re.findall(r"[\w:./+-]+", " ".join(reader.files.values()))])
    (own / "tokens").write_text("".join(f'"{_quoted(word)}"\n' for word in words if 0 < len(word) < 60))
    known: dict[str, str] = {}
    with tempfile.TemporaryDirectory(dir=_in_memory()) as name:
        folder = Path(name)

        def once(text: bytes) -> None:
            if wrong := verdict(reader, text, folder):
                kind = re.sub(r"\d+(\.\d+)? (s|MB)", "", wrong.partition(": ")[0])
                if kind not in known:
                    known[kind] = wrong
                    (finds / hashlib.sha1(text).hexdigest()[:12]).write_bytes(text)
                    print(f"FIND {given.reader}: {wrong}", flush=True)

        ends = [f"-max_total_time={60 * given.minutes:.0f}", f"-runs={given.executions}"]
        options = [
            "-timeout=60",
            "-rss_limit_mb=6000",
            f"-dict={own / 'tokens'}",
            f"-max_len={given.longest}",
            f"-artifact_prefix={finds}/",
            "-len_control=0",
        ]
        seeds = [str(inputs), *([str(found)] if (found := CORPUS / own.name).is_dir() else [])]
        atheris.Setup([sys.argv[0], *ends, *options, "-print_final_stats=1", *seeds], once)
        atheris.Fuzz()


def _quoted(token: str) -> str:
    return "".join(f"\\x{byte:02x}" for byte in token.encode())


def _in_memory() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


if __name__ == "__main__":
    main()
