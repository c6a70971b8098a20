"""docs/reliability.md names tests that exist, and docs/oracles.md is what the tests say."""

import re

from oracle_page import PAGE, TESTS, page

DOCS = PAGE.parent


def test_every_fault_of_the_page_has_its_test():
    rows = [row for row in (DOCS / "reliability.md").read_text().splitlines() if re.match(r"\| (?!fault|---)", row)]
    assert len(rows) > 30
    for row in rows:
        named = re.findall(r"`(test_\w+)::(test_\w+)`", row)
        assert named, row
        for file, test in named:
            assert f"def {test}(" in (TESTS / f"{file}.py").read_text(), row


def test_the_page_of_oracles_is_current():
    """`python tests/oracle_page.py` writes it."""
    assert (DOCS / "oracles.md").read_text() == page()
