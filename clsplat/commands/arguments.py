"""From arguments to a command: tyro with two tiers of help, short names of types, and suggestions."""

import difflib
import re
import shutil
import textwrap
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from types import NoneType
from typing import Annotated, Any, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from clsplat import config
from clsplat.commands import options
from clsplat.errors import InputError
from clsplat.ranges import rule_of

HELP, HELP_ALL = ("-h", "--help"), "--help-all"

COMMON = {
    "background",
    "device",
    "downscale",
    "exposure",
    "iterations",
    "masks",
    "max_gaussians",
    "memory_limit",
    "poses",
    "strategy",
    "test_every",
}
"""Settings that ``--help`` shows; ``--help-all`` shows the other ones as well. Flags of a command itself are shown by
both."""

LINE_MAX = 120
"""Longest line of a description, in characters; longer ones are hard to read."""

INDENT = "  "
"""Start of each line of a description, as in the boxes below; tyro would join lines that start with letters."""


def parsed(kind: Any, prog: str, arguments: list[str], default: Any = None, description: str | None = None) -> Any:
    """Parse arguments with tyro. Help and errors end the program, as tyro prints them.

    Parameters
    ----------
    kind : type
        Dataclass of a command, or a union of them.
    prog : str
        What was typed before `arguments`.
    arguments : list of str
    default : optional
        A command whose values replace the defaults of its class.
    description : str, optional
        Default: the docstring of `kind`.
    """
    registry = _Registry(brief=any(word in arguments for word in HELP) and HELP_ALL not in arguments)
    options: dict[str, Any] = {} if default is None else {"default": _without_flags(default)}
    if description or kind.__doc__:
        width = min(shutil.get_terminal_size().columns, LINE_MAX)
        text = " ".join((description or kind.__doc__).split())
        options["description"] = textwrap.fill(text, width, initial_indent=INDENT, subsequent_indent=INDENT)
    words = [HELP[1] if word == HELP_ALL else word for word in arguments]
    try:
        return tyro.cli(kind, prog=prog, args=words, registry=registry, **options)
    except SystemExit as end:
        if not end.code and registry.hidden:
            print(f"{HELP_ALL} shows every setting, and more about these.")
        raise


def _without_flags(command: Any) -> Any:
    """A command whose own flags are not set: they have no second form, so a flag that was set could not be given."""
    flags = {f.name: f.default for f in fields(command) if isinstance(f.default, bool)}
    return replace(command, **flags)


def unknown(name: str, known: list[str]) -> InputError:
    """The error of a command that does not exist, with those that are spelled alike."""
    close = difflib.get_close_matches(name, known, n=2)
    hint = f"did you mean {' or '.join(close)}?" if close else f"expected one of {', '.join(known)}"
    return InputError(f"{name}: no such command; {hint}")


class _Registry(ConstructorRegistry):
    """Rules that change how tyro presents the dataclasses of commands.

    `hidden` says whether the brief help has left out settings.
    """

    def __init__(self, brief: bool):
        super().__init__()
        self.hidden = False
        self._brief, self._inside = brief, False
        self.struct_rule(self._dataclass)
        self.primitive_rule(self._optional)

    def _dataclass(self, info: StructTypeInfo) -> StructConstructorSpec | None:
        """Leave out fixed settings, hide seldom ones, and join the lines of docstrings, which tyro wraps again."""
        if self._inside or not is_dataclass(info.type):
            return None
        self._inside = True  # tyro's own rule follows
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            self._inside = False
        assert isinstance(spec, StructConstructorSpec), "defaults are instances of their class"
        settings = info.type.__module__ in (config.__name__, options.__name__)
        fixed = {f.name: f.default for f in spec.fields if tyro.conf.Fixed in getattr(f.type, "__metadata__", ())}
        presented = tuple(self._presented(f, settings) for f in spec.fields if f.name not in fixed)
        make = spec.instantiate
        return StructConstructorSpec(lambda **values: make(**fixed, **values), presented)

    def _presented(self, field: StructFieldSpec, setting: bool) -> StructFieldSpec:
        """A field with its text on one line, and hidden if the brief help leaves it out."""
        shown: Any = field.type
        bare = get_args(shown)[0] if hasattr(shown, "__metadata__") else shown
        if bare is bool and (self._brief or not setting):  # no preset sets a flag of a command itself
            shown = Annotated[shown, tyro.conf.FlagCreatePairsOff]
        if self._brief and setting and not is_dataclass(bare) and field.name not in COMMON:
            self.hidden = True
            shown = Annotated[shown, tyro.conf.Suppress]
        if rule_of(shown) is None and (field.default is None or field.default is False):
            shown = Annotated[shown, tyro.conf.arg(help_behavior_hint="")]
        return replace(field, type=shown, helptext=lambda: self._text(field.helptext))

    def _text(self, text: str | Callable[[], str | None] | None) -> str | None:
        """A docstring on one line; only its first sentence in the brief help."""
        text = text() if callable(text) else text
        if text is None:
            return None
        line = " ".join(text.split())
        return re.split(r"(?<=[a-z)`]\.) (?=[A-Z0-9])", line)[0] if self._brief else line

    def _optional(self, info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        """Name a type that may be None as if it could not."""
        kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
        if len(kinds) != 1 or len(get_args(info.type)) != 2 or get_origin(info.type) is tuple:
            return None
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
        if not isinstance(spec, PrimitiveConstructorSpec):
            return None
        return replace(
            spec,
            instance_from_str=lambda texts: None if texts == ["None"] else spec.instance_from_str(texts),
            is_instance=lambda value: value is None or spec.is_instance(value),
            str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
        )
