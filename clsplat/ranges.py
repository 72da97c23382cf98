"""Ranges of settings, declared with the fields of dataclasses, and the check of a configuration against them.

A field's annotation holds its range, ``Annotated[float, within(least=0, below=1)]``. The command line shows it in
``--help``, and `check` refuses what is outside.
"""

import re
import shlex
from ctypes import c_float
from dataclasses import dataclass, fields, is_dataclass
from decimal import Decimal
from importlib import import_module
from reprlib import Repr
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tyro

from clsplat.errors import InputError

FLOAT32_MAX = 3.4028234663852886e38
FLOAT32_TINY = 1.1754943508222875e-38
"""Largest and smallest positive normal number of IEEE 754's single precision, in which kernels compute."""

UNITS = {"MB": 10**6, "GB": 10**9, "MiB": 2**20, "GiB": 2**30}

SIZE = "a size such as 4GB or 512MiB"

EXPECTED = {int: "an integer", float: "a finite number", str: "text", bool: "true or false", NoneType: "null"}


class Rule:
    """Condition on the value of a setting, besides its type; an instance also makes the hint in ``--help``."""

    @property
    def words(self) -> str:
        """The rule in words, after "expected"."""
        raise NotImplementedError

    def holds(self, value: Any) -> bool:
        """Whether a value of the right type is allowed."""
        raise NotImplementedError

    def __call__(self, default: str) -> str:
        return f"({self.words})" if default in ("None", "") else f"({self.words}; default: {default})"


@dataclass(frozen=True)
class Range(Rule):
    """Numbers between two ends, each of which belongs to the range (least, most) or not (above, below)."""

    least: float | None = None
    above: float | None = None
    most: float | None = None
    below: float | None = None

    @property
    def words(self) -> str:
        """See `Rule`."""
        if self.least is not None and self.most is not None:
            return f"{self.least} to {self.most}"
        ends = {"{} or more": self.least, "above {}": self.above, "at most {}": self.most, "below {}": self.below}
        return " and ".join(text.format(end) for text, end in ends.items() if end is not None)

    def holds(self, value: Any) -> bool:
        """See `Rule`. A float must be in the range in single precision, too."""
        return self.contains(value) and self.contains(single(value))

    def contains(self, value: float) -> bool:
        """Whether the range contains a number, as it is."""
        return (
            (self.least is None or value >= self.least)
            and (self.above is None or value > self.above)
            and (self.most is None or value <= self.most)
            and (self.below is None or value < self.below)
        )


@dataclass(frozen=True)
class NameIn(Rule):
    """Names in a table of a module, or in the list that a function of it returns."""

    table: str
    """Module and name, such as "clsplat.training.densify:STRATEGIES"; imported when it is needed."""

    @property
    def names(self) -> list[str]:
        """The names."""
        module, name = self.table.split(":")
        table = getattr(import_module(module), name)
        return list(table() if callable(table) else table)

    @property
    def words(self) -> str:
        """See `Rule`."""
        return f"one of {', '.join(self.names)}"

    def holds(self, value: Any) -> bool:
        """See `Rule`."""
        return value in self.names


@dataclass(frozen=True)
class ByteSize(Rule):
    """Texts that `parse_bytes` reads."""

    @property
    def words(self) -> str:
        """See `Rule`."""
        return SIZE

    def holds(self, value: Any) -> bool:
        """See `Rule`."""
        return _bytes(value) > 0


def within(
    *, least: float | None = None, above: float | None = None, most: float | None = None, below: float | None = None
) -> Any:
    """Annotation of a field of numbers: its range, as of `Range`."""
    return tyro.conf.arg(help_behavior_hint=Range(least, above, most, below))


def name_in(table: str) -> Any:
    """Annotation of a field of text: the names allowed, as of `NameIn`."""
    return tyro.conf.arg(help_behavior_hint=NameIn(table), metavar="NAME")


def byte_size() -> Any:
    """Annotation of a field of text: a number of bytes."""
    return tyro.conf.arg(help_behavior_hint=ByteSize(), metavar="SIZE")


def rule_of(hint: Any) -> Rule | None:
    """The rule in the annotation of a field, if there is one."""
    hints = (getattr(item, "help_behavior_hint", None) for item in getattr(hint, "__metadata__", ()))
    return next((item for item in hints if isinstance(item, Rule)), None)


def check(settings: Any, group: str = "") -> None:
    """Check every field of a dataclass, and of the dataclasses in it, against its type and range.

    Parameters
    ----------
    settings : a dataclass of settings
    group : str
        Name of `settings` on the command line, with a dot at the end.

    Raises
    ------
    InputError
        If a value is outside; the message names the option as it is typed, the range, and the value.
    """
    hints = get_type_hints(type(settings), include_extras=True)
    for field in fields(settings):
        value, hint = getattr(settings, field.name), hints[field.name]
        if is_dataclass(value):
            check(value, group if is_unnamed(hint) else f"{group}{field.name}.")
        elif value is not field.default:
            checked(value, hint, f"--{group}{field.name}".replace("_", "-"))


def flags_of(settings: Any, usual: Any, group: str = "") -> list[str]:
    """Settings that differ from the usual ones, as flags of the command line."""
    hints = get_type_hints(type(settings), include_extras=True)
    flags: list[str] = []
    for field in fields(settings):
        value, other = getattr(settings, field.name), getattr(usual, field.name)
        name = field.name.replace("_", "-")
        if is_dataclass(value):
            flags += flags_of(value, other, group if is_unnamed(hints[field.name]) else f"{group}{name}.")
        elif value != other:
            flag = f"--{group}{name}" if value is not False else f"--{group}no-{name}"
            flags.append(flag if isinstance(value, bool) else shlex.join([flag, str(value)]))
    return flags


def is_unnamed(hint: Any) -> bool:
    """Whether the options of a group are typed without the name of its field, whose annotation is `hint`."""
    return any(getattr(item, "name", None) == "" for item in getattr(hint, "__metadata__", ()))


def checked(value: Any, hint: Any, name: str) -> Any:
    """Check a value against the annotation of its field.

    Parameters
    ----------
    value
        An integer for a field of floats becomes a float.
    hint
        Type and, if there is one, range of the field.
    name : str
        Name of the field in errors.

    Raises
    ------
    InputError
        If the value has another type, is not among its choices, is out of range, or is not finite.
    """
    rule, kind = rule_of(hint), get_args(hint)[0] if hasattr(hint, "__metadata__") else hint
    if get_origin(kind) is tuple and isinstance(value, tuple):
        return tuple(_one(item, (get_args(kind)[0],), rule, name) for item in value)
    kinds = get_args(kind) if get_origin(kind) not in (Literal, tuple) else ()
    return _one(value, kinds or (kind,), rule, name)


def _one(value: Any, kinds: tuple[Any, ...], rule: Rule | None, name: str) -> Any:
    """Check a value against the types of its field, one of which it must have, and the rule."""
    for kind in kinds:
        if _is_of(value, kind):
            result = float(value) if kind is float else value
            if value is None or rule is None or get_origin(kind) is Literal or rule.holds(result):
                return result
    expected = " or ".join(_words(kind) for kind in kinds if kind is not NoneType)
    if rule is not None:
        expected = f"{expected}, {rule.words}" if isinstance(rule, Range) else rule.words
    rounded = ""
    if isinstance(value, float) and isinstance(rule, Range) and rule.contains(value) and not rule.holds(value):
        rounded = f", which is {single(value)} in single precision"
    raise InputError(f"{name}: expected {expected}, found {shown(value)}{rounded}")


def shown(value: Any) -> str:
    """Text of a value for a message, at most 60 characters.

    Nested values are abbreviated before they are written: aliases in YAML can stand for more text than memory holds.
    """
    brief = Repr()
    brief.maxlevel = 2
    brief.maxstring = brief.maxlong = brief.maxother = 60
    return brief.repr(value)[:60]


def _is_of(value: Any, kind: Any) -> bool:
    if get_origin(kind) is Literal:
        # 1 == True == 1.0, but only one of them is a valid choice.
        return any(value == choice and type(value) is type(choice) for choice in get_args(kind))
    if kind is float:  # finite in single precision, and thus no integer that no float64 holds
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FLOAT32_MAX
    if kind in EXPECTED:
        return type(value) is kind
    return not isinstance(kind, type) or isinstance(value, kind)


def _words(kind: Any) -> str:
    return EXPECTED.get(kind) or ", ".join(map(repr, get_args(kind))) or str(getattr(kind, "__name__", kind))


def single(value: float) -> float:
    """A float rounded to single precision, as a device computes that has no subnormal numbers; integers stay."""
    if isinstance(value, int):
        return value
    return c_float(value).value if abs(value) >= FLOAT32_TINY else 0.0


def parse_bytes(text: str, name: str) -> int:
    """Parse a number of bytes such as 4GB, 512MiB, 1.5 GB; `name` is the argument's name in errors.

    Raises
    ------
    InputError
        If it is not a positive number with one of the units MB, GB (powers of ten), MiB, GiB (of two).
    """
    if (size := _bytes(text)) == 0:
        raise InputError(f"{name}: expected {SIZE}, found {text!r}")
    return size


def _bytes(text: str) -> int:
    """A number of bytes; 0 if the text is none."""
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?(MB|GB|MiB|GiB)", text)
    return int(Decimal(match[1]) * UNITS[match[2]]) if match else 0
