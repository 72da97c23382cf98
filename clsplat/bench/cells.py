"""Trainings of `clsplat bench quality`: datasets, methods and budgets of the command line, and their combinations."""

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

from clsplat.bench.captures import STANDARD, Capture
from clsplat.bench.results import Record
from clsplat.config import DataConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.fields import METHODS
from clsplat.training.presets import YAML, load_config, load_preset, with_settings
from clsplat.training.run_length import MOST_ITERATIONS

AUTO = "auto"
"""Name of the method with default settings, which choose the number of Gaussians."""

OWN = "own"
"""Name of the budget that keeps the cap of the method's own settings."""

CAPTURE = tuple(field.name for field in fields(Capture))
"""Options of a dataset that make a variant of it; all others are for reading it."""


@dataclass(frozen=True)
class Source:
    """A dataset, the options for reading it, and the variant of it. `name` identifies all of them in results."""

    name: str
    path: Path
    data: DataConfig
    capture: Capture


@dataclass(frozen=True)
class Cell:
    """One training: a method with a cap, on a scene."""

    source: Source
    method: str
    config: TrainConfig

    def key(self, device: str) -> Record:
        """Entries that distinguish its records from those of other trainings."""
        return {
            "scene": self.source.name,
            "method": self.method,
            "max_gaussians": self.config.max_gaussians,
            "iterations": self.config.iterations,
            "seed": self.config.seed,
            "device": device,
        }

    @property
    def label(self) -> str:
        """Description for messages."""
        cap = self.config.max_gaussians
        limit = "" if cap is None else f", at most {cap:,} Gaussians"
        seed = f", seed {self.config.seed}" if self.config.seed else ""
        number = f", {self.config.iterations:,} iterations" if self.config.iterations else ""
        return f"{self.source.name}, {self.method}{limit}{number}{seed}"


def parse_source(text: str) -> Source:
    """Parse a dataset of the command line: FOLDER, or FOLDER:downscale=2:background=white:thin=4.

    Raises
    ------
    InputError
        If an option is a setting of neither `DataConfig` nor `Capture`, or its value is invalid.
    """
    # Colons before the first option belong to the path, for example after the letter of a drive.
    match = re.fullmatch(r"(.+?)((?::\w+=[^:]*)*)", text, flags=re.DOTALL)
    if match is None:
        raise InputError(f"data: expected a folder, found {text!r}")
    options = dict(option.split("=", 1) for option in match[2].split(":")[1:])
    values = {name: _value(value) for name, value in options.items()}
    variant = {name: values.pop(name) for name in CAPTURE if name in values}
    data = with_settings(DataConfig(), values, f"{text} (variants: {', '.join(CAPTURE)})")
    path = Path(match[1])
    return Source(path.resolve().name + match[2], path, data, with_settings(Capture(), variant, text))


def standard_variants(text: str) -> list[str]:
    """Datasets of the command line with each of the options of `clsplat.bench.captures.STANDARD`.

    Raises
    ------
    InputError
        As `parse_source`, or if the dataset already has options for a variant.
    """
    if parse_source(text).capture != Capture():
        raise InputError(
            f"{text}: expected no options for a variant ({', '.join(CAPTURE)}), which follow by themselves"
        )
    return [text + capture.options for capture in STANDARD]


def _value(text: str) -> Any:
    """Parse JSON; other text is a string without quotes."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def parse_method(text: str) -> tuple[str, TrainConfig]:
    """Name and settings of a method: a preset, `AUTO`, a field, or a configuration file as for ``train --config``."""
    if text == AUTO:
        return text, TrainConfig()
    if text in METHODS:
        return text, TrainConfig(iterations=METHODS[text].iterations)
    if text.endswith((".json", *YAML)):
        return Path(text).stem, load_config(Path(text))
    return text, load_preset(text)


def parse_budget(text: str, own: int | None) -> int | None:
    """Cap on the number of Gaussians for a budget. `own` is the cap of the method's own settings.

    Raises
    ------
    InputError
        If the budget is neither "own", nor a factor such as x0.5, nor a number of Gaussians.
    """
    if text == OWN:
        return own
    if re.fullmatch(r"x\d*\.?\d+", text) and float(text[1:]) > 0:
        return None if own is None else max(1, round(float(text[1:]) * own))
    if re.fullmatch(r"[1-9]\d*", text):
        return int(text)
    raise InputError(
        f"--budgets: expected {OWN}, a factor such as x0.5, or a number of Gaussians such as 40000, found {text!r}"
    )


def make_cells(
    sources: Iterable[str],
    methods: Iterable[str],
    budgets: Iterable[str],
    iterations: Iterable[int],
    memory_limit: str | None = None,
    seeds: Iterable[int] = (),
) -> list[Cell]:
    """All combinations of seed, scene, method, budget and number of iterations, in this order, without duplicates.

    Parameters
    ----------
    sources : iterable of str
        Datasets, as for `parse_source`.
    methods : iterable of str
        Methods, as for `parse_method`.
    budgets : iterable of str
        Budgets, as for `parse_budget`.
    iterations : iterable of int
        Numbers of iterations. If empty, the number of each method.
    memory_limit : str, optional
        As in `TrainConfig`.
    seeds : iterable of int
        Seeds. If empty, the seed of each method. An interrupted bench has finished all trainings of the first seed
        before those of the next one.

    Raises
    ------
    InputError
        If an argument is invalid or empty, or two datasets or two methods have the same name.
    """
    iterations, cells = list(iterations), []
    named_sources = _distinct([parse_source(text) for text in dict.fromkeys(sources)], lambda s: s.name, "data")
    named_methods = _distinct([parse_method(text) for text in dict.fromkeys(methods)], lambda m: m[0], "--methods")
    for of_cell in product(list(seeds) or (None,), named_sources, named_methods, list(budgets)):
        seed, source, (method, base), budget = of_cell
        for number in iterations or [base.iterations]:
            config = replace(
                base,
                iterations=number,
                max_gaussians=None if method in METHODS else parse_budget(budget, base.max_gaussians),
                seed=base.seed if seed is None else seed,
                data=source.data,
                # Checkpoints cost time: write one only at the end, which is not timed.
                checkpoint_every=number or MOST_ITERATIONS,
                device=None,
                memory_limit=memory_limit,
            )
            cells.append(Cell(source, method, config))
    if not cells:
        raise InputError("data, --methods and --budgets: expected at least one of each, found none of one of them")
    return list(dict.fromkeys(cells))


def _distinct(items: list[Any], name: Callable[[Any], str], what: str) -> list[Any]:
    """The items, if their names differ."""
    names = [name(item) for item in items]
    for text in names:
        if names.count(text) > 1:
            raise InputError(f"{what}: expected different names, found {text} {names.count(text)} times")
    return items


def differences(config: TrainConfig) -> Record:
    """Settings that differ from the defaults, nested as in config.json."""

    def differing(mine: Record, default: Record) -> Record:
        found = {}
        for name, value in mine.items():
            if isinstance(value, dict):
                value = differing(value, default[name])
            if value != ({} if isinstance(value, dict) else default[name]):
                found[name] = value
        return found

    return differing(asdict(config), asdict(TrainConfig()))
