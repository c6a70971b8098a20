"""Coverage-guided fuzzing of one reader with atheris; finds are written to a folder and do not end the run.

    PYTHONPATH=tests python -m fuzz.run g2o --minutes 10

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
EXECUTIONS = 1_000_000
"""After which it ends, too."""


def main() -> None:
    """Fuzz until the time or EXECUTIONS are over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reader", choices=READERS)
    parser.add_argument("--minutes", type=float, default=10.0, help="of fuzzing (default 10)")
    given = parser.parse_args()
    reader = READERS[given.reader]
    own = Path("build/fuzz").resolve() / given.reader.replace(" ", "-")
    inputs, finds = own / "inputs", own / "finds"
    for folder in (inputs, finds):
        folder.mkdir(parents=True, exist_ok=True)
    (inputs / "good").write_bytes(packed({name: text.encode() for name, text in reader.files.items()}))
    words = dict.fromkeys([*TOKENS, *re.findall(r"[\w:./+-]+", " ".join(reader.files.values()))])
    quoted = ("".join(f"\\x{byte:02x}" for byte in word.encode()) for word in words if 0 < len(word) < 60)
    (own / "tokens").write_text("".join(f'"{word}"\n' for word in quoted))
    known: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def once(text: bytes) -> None:
            if wrong := verdict(reader, text, folder):
                kind = re.sub(r"\d+(\.\d+)? (s|MB)", "", wrong.partition(": ")[0])
                if kind not in known:
                    known[kind] = wrong
                    (finds / hashlib.sha1(text).hexdigest()[:12]).write_bytes(text)
                    print(f"FIND {given.reader}: {wrong}", flush=True)

        ends = [f"-max_total_time={60 * given.minutes:.0f}", f"-runs={EXECUTIONS}"]
        options = [
            "-timeout=60",
            "-rss_limit_mb=6000",
            f"-dict={own / 'tokens'}",
            "-max_len=8192",
            f"-artifact_prefix={finds}/",
            "-len_control=0",
        ]
        seeds = [str(inputs), *([str(found)] if (found := CORPUS / own.name).is_dir() else [])]
        atheris.Setup([sys.argv[0], *ends, *options, "-print_final_stats=1", *seeds], once)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
