"""The notebooks: executed from the first cell to the last, and kept without what executing them leaves."""

import json
import os
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EACH_NOTEBOOK = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)

TIMEOUT = 600
"""Seconds per cell: the slowest takes about ten on two quiet cores."""


def test_there_are_notebooks():
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{k:02}" for k in range(10)]


@EACH_NOTEBOOK
def test_no_outputs_are_kept(path):
    notebook = json.loads(path.read_text())
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    for cell in notebook["cells"]:
        assert set(cell["metadata"]) <= {"tags"}, cell["id"]
        assert not cell.get("outputs") and cell.get("execution_count") is None, cell["id"]


@EACH_NOTEBOOK
def test_the_first_cell_names_the_wheel_for_colab(path):
    version = re.search(r"^version = (\S+)$", (ROOT / "setup.cfg").read_text(), flags=re.M)
    first = "".join(json.loads(path.read_text())["cells"][0]["source"])
    assert f"`%pip install './clsplat-{version[1]}-py3-none-any.whl[pocl]'`" in first


@EACH_NOTEBOOK
def test_links_lead_somewhere(path):
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] == "markdown":
            for target in re.findall(r"\]\((?!https?:)([^)#]+)", "".join(cell["source"])):
                assert (path.parent / target).is_file(), target


@pytest.mark.slow
@EACH_NOTEBOOK
def test_executes(path, tmp_path, monkeypatch):
    import nbclient
    import nbformat

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel shows pictures inline
    notebook = nbformat.read(path, 4)
    nbclient.NotebookClient(
        notebook, timeout=TIMEOUT, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    assert any("image/png" in output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", []))
