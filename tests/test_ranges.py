"""Ranges of settings: every field of every configuration and command is checked, at its ends and beyond them."""

import math
import re
import warnings
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import tyro
from tiny_scene import tiny_scene

from clsplat import cli
from clsplat.config import RenderConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.errors import ClsplatError, InputError
from clsplat.ranges import ByteSize, NameIn, Range, check, rule_of
from clsplat.renderer import Renderer
from clsplat.training.densify import STRATEGIES
from clsplat.training.loop import train
from clsplat.training.preparation import prepare
from clsplat.training.presets import load_config

COMMANDS = [command for command in get_args(cli.COMMANDS) if command is not cli.Bench]
BENCHMARKS = [get_args(benchmark)[0] for benchmark in get_args(cli.BENCHMARKS)]

NO_NUMBERS = [math.nan, math.inf, -math.inf, "x", [1]]


@dataclass(frozen=True)
class Setting:
    """A field of a configuration or of one in it: names from the outside to the field, option, types and rule.

    shown: whether it is an option of its command; many: whether it is a tuple of values.
    """

    root: Any
    path: tuple[str, ...]
    option: str
    kinds: tuple[Any, ...]
    rule: Any
    shown: bool
    many: bool

    def __str__(self) -> str:
        return f"{type(self.root).__name__}{self.option}"

    def changed(self, value: Any) -> Any:
        """The root with another value of this setting."""
        return changed(self.root, self.path, value)


def changed(settings: Any, path: tuple[str, ...], value: Any) -> Any:
    first, *rest = path
    return replace(settings, **{first: changed(getattr(settings, first), tuple(rest), value) if rest else value})


def plain(kind: Any) -> tuple[Any, ...]:
    """The types of a field, without None and without the tuple around them."""
    if get_origin(kind) is tuple:
        return plain(get_args(kind)[0])
    kinds = get_args(kind) if get_origin(kind) not in (Literal, None) else (kind,)
    return tuple(k for k in kinds if k is not type(None))


def settings_of(
    root: Any, part: Any, path: tuple[str, ...] = (), group: str = "", shown: bool = True
) -> Iterator[Setting]:
    hints, bare = get_type_hints(type(part), include_extras=True), get_type_hints(type(part))
    for field in fields(part):
        value, here = getattr(part, field.name), (*path, field.name)
        about = getattr(hints[field.name], "__metadata__", ())
        here_shown = shown and tyro.conf.Fixed not in about
        if is_dataclass(value):
            unnamed = any(getattr(item, "name", None) == "" for item in about)
            inner = group if unnamed else f"{group}{field.name}."
            yield from settings_of(root, value, here, inner, here_shown)
        else:
            option = f"--{group}{field.name}".replace("_", "-")
            kind = bare[field.name]
            many = get_origin(kind) is tuple
            yield Setting(root, here, option, plain(kind), rule_of(hints[field.name]), here_shown, many)


def example(command: Any) -> Any:
    """A command with its defaults, and some path or text where it has none."""
    hints = get_type_hints(command)
    required = [f.name for f in fields(command) if f.default is MISSING and f.default_factory is MISSING]
    values = {tuple: ("a",), str: "a"}
    return command(**{name: values.get(get_origin(hints[name]) or hints[name], Path("a")) for name in required})


SETTINGS = [s for root in map(example, COMMANDS + BENCHMARKS) for s in settings_of(root, root)]
TRAINING = list(settings_of(TrainConfig(), TrainConfig()))


def inside(setting: Setting) -> list[Any]:
    """The ends of the range of a setting, as far as they belong to it, or the numbers next to them."""
    rule = setting.rule
    if isinstance(rule, NameIn):
        return list(rule.names)
    if isinstance(rule, ByteSize):
        return ["1MB", "0.5 GiB"]
    if not isinstance(rule, Range):
        return list(get_args(setting.kinds[0]) if get_origin(setting.kinds[0]) is Literal else [])
    ends = [rule.least, rule.most]
    ends += [None if end is None else beyond(setting, end, away) for end, away in ((rule.above, 1), (rule.below, -1))]
    return [setting.kinds[0](end) for end in ends if end is not None]


def outside(setting: Setting) -> list[Any]:
    """Values just beyond the ends, and none that are numbers."""
    rule, kind = setting.rule, setting.kinds[0]
    if isinstance(rule, NameIn):
        return ["", rule.names[0].swapcase(), 3]
    if isinstance(rule, ByteSize):
        return ["", "4", "0GB", "-1GB", "nanGB", 4]
    if get_origin(kind) is Literal:
        return [1.5, "", True]
    if kind is bool:
        return [0, "yes"]
    if kind in (str, Path) or not isinstance(rule, Range):
        return [3]
    ends = [rule.above, rule.below]
    ends += [None if end is None else beyond(setting, end, away) for end, away in ((rule.least, -1), (rule.most, 1))]
    return [kind(end) for end in ends if end is not None] + NO_NUMBERS


def beyond(setting: Setting, end: float, away: int) -> float:
    """The number next to the end of a range."""
    if setting.kinds[0] is int:
        return end + away
    if end == 0:
        return away * float(np.finfo(np.float32).tiny)
    return float(np.nextafter(np.float32(end), np.float32(away * np.inf)))


def test_no_number_is_without_a_range():
    assert [str(s) for s in SETTINGS + TRAINING if s.kinds[0] in (int, float) and not isinstance(s.rule, Range)] == []


def test_the_walk_finds_the_settings():
    found = {s.option for s in SETTINGS if type(s.root) is cli.Train}
    assert {"--iterations", "--optim.means-lr", "--test-every", "--sfm.camera-model", "--near"} < found
    assert len(found) > 90


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_the_ends_of_a_range(setting):
    check(setting.root)
    for value in inside(setting):
        check(setting.changed((value, value) if setting.many else value))
    for value in outside(setting):
        with pytest.raises(InputError, match=rf"^{setting.option}: expected .*, found {re.escape(repr(value))[:50]}"):
            check(setting.changed((value,) if setting.many else value))


def test_single_precision_counts():
    with pytest.raises(InputError, match=r"found 0\.99999999999, which is 1\.0 in single precision"):
        check(changed(TrainConfig(), ("optim", "beta1"), 0.99999999999))
    with pytest.raises(InputError, match=r"found 1e-40, which is 0\.0 in single precision"):
        check(changed(TrainConfig(), ("optim", "eps"), 1e-40))


@pytest.mark.parametrize("command", ["train", "render", "compact", "bench kernels"])
def test_help_shows_the_ranges(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help-all"])
    text = "".join(capsys.readouterr().out.replace("│", " ").split())  # lines break anywhere
    root = {"train": cli.Train, "render": cli.Render, "compact": cli.Compact}.get(command, cli.Kernels)
    for setting in (s for s in SETTINGS if type(s.root) is root and s.rule is not None):
        assert (setting.option in text) == setting.shown, setting
        words = f"({setting.rule.words}".replace(" ", "")
        assert not setting.shown or f"{words};default:" in text or f"{words})" in text, setting


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "none", "-o", "out", "--strategy", "foo"], f"--strategy: expected one of {', '.join(STRATEGIES)}"),
        (["train", "none", "-o", "out", "--optim.beta1", "1"], "--optim.beta1: expected a finite number, 0 or more"),
        (["train", "none", "-o", "out", "--size-price", "inf"], "--size-price: expected a finite number, 0 or more"),
        (["train", "none", "-o", "out", "--preset", "mcmc", "--seed", "-1"], "--seed: expected an integer, 0 to"),
        (["demo", "-o", "out", "--iterations", "0"], "--iterations: expected an integer, 1 to"),
        (["render", "none.ply", "none", "-o", "out", "--frames", "0"], "--frames: expected an integer, 1 or more"),
        (["view", "none.ply", "--near", "nan"], "--near: expected a finite number, above 0, found nan"),
        (["train", "none", "-o", "out", "--viewer", "--port", "65536"], "--port: expected an integer, 0 to 65535"),
        (["eval", "none.ply", "none", "-o", "out", "--near", "0"], "--near: expected a finite number, above 0"),
        (["compact", "none.ply", "-o", "a.spz", "--max-bytes", "9"], "--max-bytes: expected a size such as"),
        (["sfm", "none", "--min-registered", "1"], "--min-registered: expected an integer, 2 to"),
        (["frames", "none.mp4", "-o", "out", "--fps", "0"], "--fps: expected a finite number, above 0, found 0"),
        (["bench", "quality", "none", "-o", "out", "--seeds", "0", "-1"], "--seeds: expected an integer, 0 to"),
        (["bench", "captures", "none", "-o", "out", "--iterations", "0"], "--iterations: expected an integer, 1 to"),
        (["bench", "kernels", "--views", "0"], "--views: expected an integer, 1 or more, found 0"),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, list) else "",
)
def test_commands_refuse_before_they_read(arguments, message, tmp_path, monkeypatch, capsys):
    """None of the files exists, and none is missed."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_:
        cli.main(arguments)
    assert exit_.value.code == 2
    assert f"clsplat: {message}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_files_of_settings_are_checked(tmp_path):
    (tmp_path / "a.json").write_text('{"optim": {"beta2": 1}}')
    with pytest.raises(InputError, match=r"a\.json: optim\.beta2: expected .* 0 or more and below 1, found 1"):
        load_config(tmp_path / "a.json")


def test_python_is_checked_before_it_reads(tmp_path):
    negative = changed(TrainConfig(), ("error", "every"), -1)
    for bad in (TrainConfig(seed=-1), TrainConfig(checkpoint_every=0), negative):
        with pytest.raises(InputError, match=r"^--(seed|checkpoint-every|error\.every): expected an integer"):
            prepare(tmp_path / "none", bad)
        with pytest.raises(InputError, match=r"^--(seed|checkpoint-every|error\.every): expected an integer"):
            train(tiny_scene(), bad, tmp_path / "out")
    with pytest.raises(InputError, match=r"^--test-every: expected an integer"):
        load_scene(tmp_path / "none", replace(TrainConfig().data, test_every=-1))
    with pytest.raises(InputError, match=r"^--near: expected"):
        Renderer("reference", RenderConfig(near=math.nan))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("background", [(0.0, 0.0), (0.0, math.nan, 0.0), "white", None, (0, 0, math.inf), 0.5])
def test_a_background_is_three_finite_numbers(background):
    with pytest.raises(InputError, match="background: expected three finite numbers, RGB, found"):
        Renderer("reference", background=background)


def test_a_device_is_no_text():
    with pytest.raises(InputError, match=r"cl_device: expected a device, .*, found 'GPU'"):
        Device("GPU")


TRAINED = [s for s in TRAINING if isinstance(s.rule, Range) and s.path not in {("iterations",)}]
"""Settings with ends that can be trained with: 2**32 - 1 iterations would not end."""


def active(setting: Setting) -> TrainConfig:
    """A short training in which a setting has an effect."""
    config = TrainConfig(iterations=3, size="fixed", max_gaussians=40, exposure=True, poses=True, dropout=0.1)
    config = replace(config, strategy=setting.path[0] if setting.path[0] in STRATEGIES else "error")
    for name in STRATEGIES:
        rounds = replace(getattr(config, name), every=1, start=0, stop_fraction=1.0)
        config = replace(config, **{name: rounds})
    few = replace(config.few, below=99 if setting.path[0] == "few" else 0)
    return replace(config, few=few, coarse=replace(config.coarse, factor=2))


@pytest.mark.parametrize("setting", TRAINED, ids=str)
def test_a_training_at_the_ends_of_a_range_ends(setting, device, tmp_path):
    scene = tiny_scene()
    for value in inside(setting):
        config = changed(active(setting), setting.path, value)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's, of overflow
            try:
                prepared = prepare(tmp_path, config, device, scene=scene)
                gaussians = train(*prepared, tmp_path / "out", device)
            except ClsplatError as error:
                assert str(error)
            else:
                assert all(np.isfinite(array).all() for array in gaussians.arrays().values())
