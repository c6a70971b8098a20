"""Mutated files: whatever stands in one, a reader keeps its contract (`tests/fuzz/contract.py`)."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from fuzz.contract import verdict
from fuzz.readers import READERS, packed
from fuzz.tokens import TOKENS

CORPUS = Path(__file__).parent / "fuzz" / "corpus"


def mutated(text, rng):
    """One to four changes: a token or a byte replaced, a line repeated, moved or cut, the end torn off."""
    draw = rng.integers
    data = text
    for _ in range(draw(1, 5)):
        kind, at = int(draw(8)), int(draw(max(len(data), 1)))
        lines = data.split("\n")
        line = int(draw(len(lines)))
        if kind <= 2:
            words = re.split('([, "\n])', data)
            words[int(draw(len(words)))] = str(rng.choice(TOKENS))
            data = "".join(words)
        elif kind == 3:
            data = data[:at] + chr(int(rng.choice([*range(32, 127), 0, 9, 228, 8232]))) + data[at + 1 :]
        elif kind == 4:
            lines.insert(line, lines[line])
            data = "\n".join(lines)
        elif kind == 5:
            del lines[line]
            data = "\n".join(lines)
        elif kind == 6:
            other = int(draw(len(lines)))
            lines[line], lines[other] = lines[other], lines[line]
            data = "\n".join(lines)
        else:
            data = data[:at] if rng.uniform() < 0.5 else data[at:]
    raw = data.encode("utf-8", "surrogatepass")
    if rng.uniform() < 0.1 and raw:
        cut = int(draw(len(raw)))
        raw = raw[:cut] + bytes([int(draw(256))]) + raw[cut + 1 :]
    return raw


@pytest.mark.parametrize("name", READERS)
def test_a_mutated_file_ends_in_our_exceptions(tmp_path, name):
    reader = READERS[name]
    files = {file: text.encode() for file, text in reader.files.items()}
    assert not verdict(reader, packed(files), tmp_path)
    reader.read(tmp_path)  # as it stands it is right, which a verdict does not say
    found = {}
    for seed in range(int(os.environ.get("COOPOC_MUTANTS", "70"))):
        rng = np.random.default_rng([seed, len(name)])
        file = sorted(files)[int(rng.integers(len(files)))]
        if wrong := verdict(reader, packed({**files, file: mutated(reader.files[file], rng)}), tmp_path):
            found[seed] = wrong
    assert not found


@pytest.mark.parametrize("name", READERS)
def test_the_corpus_of_the_coverage_guided_run_ends_in_our_exceptions(tmp_path, name):
    """Finds of `make fuzz`, each mended since, and inputs that reach other lines than the good files."""
    found = {}
    for path in sorted((CORPUS / name.replace(" ", "-")).glob("*")):
        if wrong := verdict(READERS[name], path.read_bytes(), tmp_path):
            found[path.name] = wrong
    assert not found
