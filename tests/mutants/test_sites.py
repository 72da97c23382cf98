"""Mutants of source text: one operator, constant or index is changed, and no comment."""

import ast
from pathlib import Path

import measure_mutants
import pytest
from sites import drawn, mutants

OPENCL = """// 1 + 2
#if WIDTH > 3
#define HALF 0.5f
#endif
float f(float4 v, global const int *p, int i) {
    /* a * b */
    if (i >= 8 && p[1] < 2)
        return v.x * 0.25f - HALF;
    return -v.w;
}
"""

PYTHON = '''"""1 + 2"""

SHARE = 1 / 6  # 3 * 4


def f(ä, b):
    return ä * b[0] if ä <= 2 and b is not None else -b[1]
'''


def changes(folder: Path, name: str, text: str) -> set[tuple[int, str, str]]:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    found = mutants(path, folder)
    assert all(text[m.start :].startswith(m.before) and m.applied(text) != text for m in found)
    if name.endswith(".py"):
        for mutant in found:
            ast.parse(mutant.applied(text))
    return {(m.line, m.before, m.after) for m in found}


def test_kernels(tmp_path: Path) -> None:
    """By hand."""
    assert changes(tmp_path, "a.cl", OPENCL) == {
        (3, "0.5", "0.5625"),
        (7, ">=", ">"),
        (7, "8", "9"),
        (7, "&&", "||"),
        (7, "1", "2"),
        (7, "<", "<="),
        (7, "2", "3"),
        (8, "x", "y"),
        (8, "*", "/"),
        (8, "0.25", "0.28125"),
        (8, "-", "+"),
        (9, "w", "z"),
    }


def test_python(tmp_path: Path) -> None:
    """By hand; a letter of two bytes is before the changes."""
    assert changes(tmp_path, "a.py", PYTHON) == {
        (3, "/", "*"),
        (3, "1", "2"),
        (3, "6", "7"),
        (7, "*", "/"),
        (7, "0", "1"),
        (7, "<=", "<"),
        (7, "2", "3"),
        (7, "and", "or"),
        (7, "is not", "is"),
        (7, "1", "2"),
    }


@pytest.mark.parametrize("count", [5, 10_000])
def test_draws_are_spread_over_files_and_repeat(tmp_path: Path, count: int) -> None:
    for name in ("a.cl", "b.cl"):
        (tmp_path / name).write_text(OPENCL)
    files = sorted(tmp_path.iterdir())
    chosen = drawn(files, tmp_path, count, seed=0)
    assert chosen == drawn(files, tmp_path, count, seed=0)
    assert len(set(chosen)) == len(chosen)
    assert {m.path for m in chosen} == {"a.cl", "b.cl"}
    assert count == 5 or len(chosen) == 24


def test_every_measured_file_has_tests() -> None:
    for path in measure_mutants.measured_files():
        for test in measure_mutants.tests_of(path.relative_to(measure_mutants.ROOT).as_posix()):
            assert (measure_mutants.ROOT / test).is_file(), f"{path}: {test}"
