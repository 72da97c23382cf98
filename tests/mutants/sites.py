"""Mutants of source text: places where one operator, constant or index is changed."""

import ast
import random
import re
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path

OPERATORS = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "//": "*",
    "**": "*",
    "%": "*",
    "@": "*",
    "<": "<=",
    "<=": "<",
    ">": ">=",
    ">=": ">",
    "==": "!=",
    "!=": "==",
    "&&": "||",
    "||": "&&",
    "and": "or",
    "or": "and",
    "&": "|",
    "|": "&",
    "<<": ">>",
    ">>": "<<",
    "+=": "-=",
    "-=": "+=",
    "*=": "/=",
    "in": "not in",
    "not in": "in",
    "is": "is not",
    "is not": "is",
}
"""Each operator, and the one in its place."""

COMPONENTS = {"x": "y", "y": "x", "z": "x", "w": "z"}
"""Each component of a vector of OpenCL C, and the one in its place."""

# clang-format puts spaces around binary operators and none around unary ones.
_C_OPERATOR = re.compile(r"(?<= )(?:\+=|-=|\*=|<<|>>|<=|>=|==|!=|&&|\|\||[-+*/%<>&|])(?= )")
_C_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d*)?(?:e[-+]?\d+)?(?=f?\b)(?![xX])")
_C_COMPONENT = re.compile(r"(?<=[\w\])]\.)[xyzw]\b")
_C_NO_CODE = re.compile(r"//[^\n]*|/\*.*?\*/|\"[^\"\n]*\"|^[ \t]*#[ \t]*(?!define)[^\n]*", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Mutant:
    """A change of a file: `before`, which begins at the offset `start`, becomes `after`."""

    path: str
    line: int
    start: int
    before: str
    after: str

    def applied(self, text: str) -> str:
        """The text of the file with the change."""
        return text[: self.start] + self.after + text[self.start + len(self.before) :]


def mutants(path: Path, root: Path) -> list[Mutant]:
    """All mutants of a file of Python or of OpenCL C, by their place."""
    text = path.read_text(encoding="utf-8")
    found = _python(text) if path.suffix == ".py" else _opencl(text)
    name = path.relative_to(root).as_posix()
    return [Mutant(name, text.count("\n", 0, at) + 1, at, before, after) for at, before, after in sorted(found)]


def drawn(files: list[Path], root: Path, count: int, seed: int) -> list[Mutant]:
    """Draw mutants at random, in random order: at least one of each file, and of all files the same fraction."""
    by_file = [mutants(path, root) for path in files]
    share = min(1.0, count / sum(map(len, by_file)))
    rng = random.Random(seed)
    counts = [min(len(found), max(1, round(share * len(found)))) for found in by_file]
    result = [mutant for found, n in zip(by_file, counts, strict=True) for mutant in rng.sample(found, n)]
    rng.shuffle(result)
    return result


def _number(text: str) -> str:
    """Another number: the next integer, or an eighth more, which is above all tolerances of tests."""
    if text.isdigit():
        return str(int(text) + 1)
    return repr(float(text) * 1.125 if float(text) else 1.0)


def _opencl(text: str) -> set[tuple[int, str, str]]:
    code = _C_NO_CODE.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)
    changes = {(m.start(), m[0], OPERATORS[m[0]]) for m in _C_OPERATOR.finditer(code)}
    changes |= {(m.start(), m[0], _number(m[0])) for m in _C_NUMBER.finditer(code)}
    return changes | {(m.start(), m[0], COMPONENTS[m[0]]) for m in _C_COMPONENT.finditer(code)}


def _python(text: str) -> set[tuple[int, str, str]]:
    # Columns of `ast` are bytes; the sources of the project are encoded in UTF-8.
    raw = text.encode()
    starts = [0, *accumulate(map(len, raw.splitlines(keepends=True)))]

    def begin(node: ast.expr) -> int:
        return starts[node.lineno - 1] + node.col_offset

    def end(node: ast.expr) -> int:
        return starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)

    changes = set()
    for node in ast.walk(ast.parse(text)):
        operands: list[ast.expr] = []
        if isinstance(node, ast.BinOp):
            operands = [node.left, node.right]
        elif isinstance(node, ast.Compare):
            operands = [node.left, *node.comparators]
        elif isinstance(node, ast.BoolOp):
            operands = node.values
        for left, right in pairwise(operands):
            between = raw[end(left) : begin(right)].decode()
            operator = re.search(r"(?<!\S)[^\s()#]+(?: not| in)?(?!\S)", between)
            if operator and operator[0] in OPERATORS:
                at = len(raw[: end(left)].decode()) + operator.start()
                changes.add((at, operator[0], OPERATORS[operator[0]]))
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            literal = raw[begin(node) : end(node)].decode()
            number = str(node.value + 1) if isinstance(node.value, int) else _number(repr(node.value))
            changes.add((len(raw[: begin(node)].decode()), literal, number))
    return changes
