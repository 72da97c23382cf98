"""The files at the top of the project: they parse, and say what setup.cfg says."""

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from clsplat.programs import kernel_folder

ROOT = Path(__file__).parents[1]
SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg")


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "title", "message", "authors"} <= citation.keys()
    assert citation["version"] == SETUP["metadata"]["version"]
    assert citation["license"] == SETUP["metadata"]["license"]
    assert citation["references"][0]["doi"] in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("path", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda p: p.stem)
def test_templates_of_issues_are_forms(path: Path) -> None:
    form = yaml.safe_load(path.read_text())
    assert {"name", "description", "body"} <= form.keys()
    ids = [part["id"] for part in form["body"]]
    assert len(set(ids)) == len(ids)
    for part in form["body"]:
        assert part["type"] in ("textarea", "input", "dropdown", "markdown") and part["attributes"]["label"]


def test_the_container_installs_extras_that_exist() -> None:
    (extras,) = re.findall(r"/src\[([a-z,]+)\]", (ROOT / "Dockerfile").read_text())
    assert set(extras.split(",")) <= SETUP["options.extras_require"].keys()


def test_the_guide_for_contributors_names_targets_that_exist() -> None:
    text, makefile = (ROOT / "CONTRIBUTING.md").read_text(), (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"\bmake ([a-z][a-z-]*)", text))
    assert len(targets) >= 4
    assert targets <= set(re.findall(r"^([a-z-]+):", makefile, flags=re.M))


def test_kernels_are_formatted() -> None:
    if shutil.which("clang-format") is None:
        pytest.skip("clang-format is missing: install it to check the kernels' format")
    files = sorted(kernel_folder().glob("*.cl")) + sorted(kernel_folder().glob("*.h"))
    command = ["clang-format", "--dry-run", "--Werror", *map(str, files)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
