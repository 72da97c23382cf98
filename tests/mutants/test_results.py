"""The page of the mutation tests says what the results say."""

import json
from pathlib import Path

import pytest
from measure_mutants import ROOT


@pytest.mark.parametrize(
    ("name", "measured", "heading"),
    [("mutants", 300, "### What survived\n"), ("mutants-newer", 60, "### What survived of the later stages\n")],
)
def test_the_page_has_the_numbers_of_the_results(name: str, measured: int, heading: str) -> None:
    lines = (ROOT / "docs" / "results" / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    results = [json.loads(line) for line in lines]
    survived = [result for result in results if not result["killed"]]
    page = Path(ROOT / "docs" / "mutants.md").read_text(encoding="utf-8")
    assert len(results) >= measured and len({tuple(result["key"]) for result in results}) == len(results)
    share = 100 * (1 - len(survived) / len(results))
    assert f"**{len(results) - len(survived)} of {len(results)} are killed, {share:.1f} %**" in page
    listed = page.split(heading)[1].split("\n## ")[0]
    assert sum(row.startswith("* ") for row in listed.splitlines()) == len(survived)
    for result in survived:
        assert f"`{result['before']}` → `{result['after']}`" in listed and f"`{result['path']}`:" in listed
