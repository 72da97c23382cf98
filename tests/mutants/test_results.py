"""The page of the mutation tests says what the results say."""

import json
from pathlib import Path

from measure_mutants import ROOT


def test_the_page_has_the_numbers_of_the_results() -> None:
    lines = (ROOT / "docs" / "results" / "mutants.jsonl").read_text(encoding="utf-8").splitlines()
    results = [json.loads(line) for line in lines]
    survived = [result for result in results if not result["killed"]]
    page = Path(ROOT / "docs" / "mutants.md").read_text(encoding="utf-8")
    assert len(results) >= 300 and len({tuple(result["key"]) for result in results}) == len(results)
    share = 100 * (1 - len(survived) / len(results))
    assert f"**{len(results) - len(survived)} of {len(results)} are killed, {share:.1f} %**" in page
    rows = page.split("## What survived")[1].splitlines()
    assert sum(row.startswith("* ") for row in rows) == len(survived)
    for result in survived:
        assert f"`{result['before']}` → `{result['after']}`" in page
