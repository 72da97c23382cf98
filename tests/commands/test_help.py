"""Help texts, and what a misspelled command or flag is answered."""

import dataclasses
import os
import subprocess
import sys
import typing
from pathlib import Path

import pytest

from clsplat import cli, config
from clsplat.commands.arguments import COMMON

SCREEN = 100, 48
"""Columns and lines of a terminal in which brief help fits: half of a full-HD screen."""

COMMANDS = [command.__name__.lower() for command in typing.get_args(cli.COMMANDS)]


def printed(capsys: pytest.CaptureFixture[str], *arguments: str, columns: int = SCREEN[0]) -> str:
    """Run a command that ends by itself; return what it printed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", str(columns))
        with pytest.raises(SystemExit) as exit_:
            cli.main(list(arguments))
    text = capsys.readouterr()
    assert not exit_.value.code, text.err
    return text.out


@pytest.mark.parametrize("command", ["", *COMMANDS])
@pytest.mark.parametrize("columns", [60, SCREEN[0]])
def test_help_fits_the_terminal(command: str, columns: int, capsys: pytest.CaptureFixture[str]) -> None:
    for flag in ("--help", "-h", "--help-all"):
        text = printed(capsys, *command.split(), flag, columns=columns)
        assert max(map(len, text.split("\n\n", 1)[1].splitlines())) <= columns, "except for the usage"
        assert "None" not in text.replace("such as None", "") and "{fixed}" not in text
        if flag != "--help-all" and columns == SCREEN[0]:
            assert len(text.splitlines()) <= SCREEN[1]


def test_all_help_has_every_setting_and_brief_help_the_common_ones(capsys: pytest.CaptureFixture[str]) -> None:
    brief, whole = printed(capsys, "train", "--help"), printed(capsys, "train", "--help-all")
    for flag in ("--adc.grad-threshold", "--sfm.matching", "--seed", "--tile-size"):
        assert flag in whole and flag not in brief
    for name in COMMON:
        assert f"--{name.replace('_', '-')} " in brief, name
    assert "--help-all shows every setting" in brief and "--help-all" not in whole
    joined = [" ".join(text.replace("│", "").split()) for text in (whole, brief)]
    assert "others stay on disk" in joined[0] and "others stay on disk" not in joined[1]


def test_every_common_setting_exists() -> None:
    names = {f.name for _, c in vars(config).items() if dataclasses.is_dataclass(c) for f in dataclasses.fields(c)}
    assert names >= COMMON


USELESS = {
    "export": ("--masks", "--sfm.matching", "--downscale", "--test-every", "--random-background", "--device"),
    "eval": ("--random-background", "--mode", "--sfm.matching"),
    "render": ("--masks", "--random-background", "--mode", "--sfm.matching"),
    "view": ("--masks", "--test-every", "--random-background", "--mode", "--sfm.matching"),
    "compact": ("--random-background", "--mode", "--sfm.matching"),
}


@pytest.mark.parametrize("command", USELESS)
def test_flags_without_effect_are_not_accepted(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, command, "--help-all")
    for flag in USELESS[command]:
        assert flag not in text
        with pytest.raises(SystemExit) as exit_:
            cli.main([command, "a.ply", "b", flag, "1"])
        assert exit_.value.code == 2 and flag in capsys.readouterr().err


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as exit_:
        cli.main(list(arguments))
    assert exit_.value.code == 2
    return " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_misspelled_commands_and_flags_are_answered_with_the_right_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, "exprot", "a", "b") == "clsplat: exprot: no such command; did you mean export?"
    assert "expected one of train, view, export," in refused(capsys, "zzz")
    assert "Perhaps you meant: --iterations INT" in refused(capsys, "train", "a", "-o", "b", "--iteration", "3")
    assert "Perhaps you meant: --data DATASET" in refused(capsys, "export", "a", "b", "--dta", "x")


def test_the_version_and_a_program_without_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["--version"])
    setup = (Path(__file__).parents[2] / "setup.cfg").read_text()
    assert f"version = {capsys.readouterr().out.split()[1]}\n" in setup
    assert printed(capsys) == printed(capsys, "--help")


@pytest.mark.parametrize("flag", ["--viewer", "--resume"])
def test_a_flag_can_be_given_with_a_preset(flag: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[bool, str]] = []
    name = flag.removeprefix("--")
    monkeypatch.setattr(
        "clsplat.commands.train.Train.run", lambda self: seen.append((getattr(self, name), self.settings.strategy))
    )
    cli.main(["train", "photos", "-o", "out", "--preset", "mcmc", flag])
    assert seen == [(True, "mcmc")]


def test_the_first_lines_of_help_explain_a_default_of_zero_and_name_no_empty_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = " ".join(printed(capsys, "train", "--help").replace("│", " ").split())
    assert "0: chosen by the photos. (0 to" in text
    assert "default: )" not in printed(capsys, "mesh", "--help-all")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of another kind on this system")
def test_a_reader_that_ends_early_is_no_error(tmp_path: Path) -> None:
    """As ``clsplat info scene.ply | head -1`` has."""
    line = f"{sys.executable} -c 'from clsplat.cli import main; main()' train --help-all | head -c 1"
    folder = Path(__file__).parents[2]
    found = subprocess.run(
        line, shell=True, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, text=True
    )
    assert found.stderr == "" and len(found.stdout) == 1


def test_a_setting_can_still_be_unset(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[object] = []
    monkeypatch.setattr("clsplat.commands.train.Train.run", lambda self: seen.append(self.settings.max_gaussians))
    (tmp_path / "some.json").write_text('{"max_gaussians": 7}')
    base = ["train", "photos", "-o", "out", "--config", str(tmp_path / "some.json")]
    for flags in ([], ["--max-gaussians", "5"], ["--max-gaussians", "None"]):
        cli.main([*base, *flags])
    assert seen == [7, 5, None]
