"""The documentation: its Python examples run, and nothing that exists is left out of it."""

import ast
import dataclasses
import doctest
import importlib
import re
import typing
from pathlib import Path

import pytest

import clsplat
from clsplat import cli, config, constants, formats, ops
from clsplat.stages import FUNCTIONS
from clsplat.training import densify, presets

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


WITH_EXAMPLES = ["README.md", *(f"docs/howto/{name}.md" for name in ("python", "memory", "compact"))]


@pytest.mark.parametrize("page", WITH_EXAMPLES)
def test_python_examples_run(page, device, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYOPENCL_NO_CACHE", "1")
    examples = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), flags=re.M | re.S)
    assert examples, f"{page} has no example"
    names: dict[str, object] = {}
    for example in examples:
        exec(compile(example, page, "exec"), names)


def test_every_public_name_is_listed():
    page = (DOCS / "api" / "index.rst").read_text()
    for name in clsplat.__all__:
        assert re.search(rf"^   ~clsplat\.[\w.]+\.{name}$", page, flags=re.M), name


def test_every_configuration_has_a_table():
    page = (DOCS / "configuration.md").read_text()
    for name, cls in vars(config).items():
        if dataclasses.is_dataclass(cls):
            assert f"```{{config}} {name}\n" in page, name


def test_every_preset_is_described():
    page = (DOCS / "configuration.md").read_text()
    for name in presets.PRESETS:
        assert re.search(rf"^\* .*`{name}`.*:", page, flags=re.M), name


def test_every_command_has_its_help():
    page = (DOCS / "cli.md").read_text()
    for command in typing.get_args(cli.COMMANDS):
        assert f"```{{command}} {command.__name__.lower()}\n" in page, command.__name__


def test_every_constant_says_why():
    source = Path(constants.__file__).read_text()
    for name in vars(constants):
        if re.fullmatch(r"[A-Z][A-Z0-9_]*", name):
            # Neighbours may share a docstring.
            assert re.search(rf'^{name}\b.*\n(?:[A-Z].* = .*\n)*"""', source, flags=re.M), name


def test_every_stage_has_a_page_with_twin_and_kernel():
    stages = {getattr(ops, name).__module__.rsplit(".", 1)[1] for name in FUNCTIONS}
    index = (DOCS / "stages" / "index.md").read_text()
    for stage in stages:
        assert f"\n{stage}\n" in index, stage
        page = (DOCS / "stages" / f"{stage}.md").read_text()
        assert f"literalinclude}} ../../clsplat/reference/{stage}.py" in page, stage
        kernels = [p.name for p in (ROOT / "cl").glob(f"{stage}*.cl")]
        assert kernels and all(f"literalinclude}} ../../cl/{name}" in page for name in kernels), stage


def test_every_function_of_a_stage_is_listed():
    page = (DOCS / "api" / "stages.rst").read_text()
    for name in FUNCTIONS:
        assert f"\n.. autofunction:: {name}\n" in page, name


def test_every_header_is_on_a_page():
    pages = "".join(page.read_text() for page in (DOCS / "stages").glob("*.md"))
    for header in (ROOT / "cl").glob("*.h"):
        assert f"../../cl/{header.name}" in pages, header.name


def test_every_strategy_is_described():
    page = (DOCS / "howto" / "photos.md").read_text()
    for name in densify.STRATEGIES:
        assert f"`{name}`" in page, name


def test_every_format_is_measured():
    page = (DOCS / "formats.md").read_text()
    for suffix in formats.FORMATS:
        assert page.count(f"| `{suffix}` |") == 2, suffix  # what is kept, and what it costs
    for suffix in (*formats.READ_ONLY, *formats.WRITE_ONLY):
        assert page.count(f"| `{suffix}` |") == 1, suffix


def messages():
    """Every text in the package as its author meant it: parts joined, … for what is filled in."""
    for path in (ROOT / "clsplat").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                yield "".join(v.value if isinstance(v, ast.Constant) else "…" for v in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


def test_every_message_under_troubleshooting_exists():
    page = (DOCS / "howto" / "troubleshooting.md").read_text()
    headings = re.findall(r"^### `(.*)`$", page, flags=re.M)
    assert len(headings) > 20
    known = list(messages())
    for heading in headings:
        pattern = re.compile(".*".join(map(re.escape, heading.split("…"))))
        assert any(pattern.match(text) for text in known), heading


def slugs(page):
    """Anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    for heading in re.findall(r"^#+ (.*)$", text, flags=re.M):
        yield re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


def tables(page):
    """Anchors of what Sphinx makes of directives: the headings of constants and configuration classes."""
    return [name.lower() for name in re.findall(r"```\{\w+\} (\w+)", page.read_text())]


PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("*/*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    text = re.sub(r"`[^`\n]*`", "", text)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target) or "api/" in target:  # the API's pages are named without a suffix
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        if file.suffix == ".ipynb":  # docs/notebooks holds copies
            file = ROOT / "notebooks" / file.name
        assert file.exists(), f"{target}: no such file"
        if anchor and file.suffix == ".md":
            assert anchor in set(slugs(file)) | set(tables(file)), f"{target}: no such heading"


WITH_DOCTESTS = [path for path in (ROOT / "clsplat").rglob("*.py") if ">>>" in path.read_text()]


@pytest.mark.parametrize("path", WITH_DOCTESTS, ids=lambda path: path.stem)
def test_examples_in_docstrings_hold(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    outcome = doctest.testmod(importlib.import_module(".".join(p for p in parts if p != "__init__")))
    assert outcome.attempted and not outcome.failed
