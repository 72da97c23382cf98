"""The count of fuzzed cases, said at the end of a run."""

from collections import Counter

import pytest

CASES: Counter[str] = Counter()


@pytest.fixture(scope="session")
def cases():
    """Number of cases per kind; tests add what they try."""
    return CASES


def pytest_terminal_summary(terminalreporter):
    if CASES:
        terminalreporter.write_line(f"fuzzed: {sum(CASES.values())} cases: {dict(CASES)}")
