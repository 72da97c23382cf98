"""The number of fuzzed cases, reported at the end of a run."""

from collections import Counter

import pytest

CASES: Counter[str] = Counter()


@pytest.fixture(scope="session")
def cases():
    """Number of cases per kind. Tests add theirs."""
    return CASES


def pytest_terminal_summary(terminalreporter):
    if CASES:
        terminalreporter.write_line(f"fuzzed: {sum(CASES.values())} cases: {dict(CASES)}")
