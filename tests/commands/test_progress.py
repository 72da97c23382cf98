"""The progress bar of a training."""

import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from clsplat.commands.progress import Progress
from clsplat.config import TrainConfig


def test_the_bar_takes_the_line_of_what_the_training_waited_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """tqdm gives a second line to a bar that begins before another one has ended."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    scene: Any = SimpleNamespace(train=[], test=[])
    renderer: Any = SimpleNamespace(device=None, label="device")
    progress = Progress(scene, TrainConfig(iterations=10), renderer, tmp_path, None, lambda: None)
    monkeypatch.setattr(progress, "show", lambda: None)
    with progress.watching():
        while "compiling kernels" not in capsys.readouterr().err:
            time.sleep(0.01)
        progress.after({"iteration": 1, "loss": 0.5, "num_gaussians": 7, "gaussians": None})
        assert progress._bar is not None and progress._bar.pos == 0


def test_the_estimate_leaves_out_a_pause(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [100.0]
    monkeypatch.setattr("clsplat.commands.progress.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])

    class Viewer:
        """A viewer in which someone pauses the training for an hour after the second step."""

        def follow(self, *_: object) -> None:
            now[0] += 3600 if progress._bar is not None and progress._bar.n == 2 else 0

        def __getattr__(self, name: str) -> Any:
            return lambda *_: None

    scene: Any = SimpleNamespace(train=[], test=[])
    renderer: Any = SimpleNamespace(device=None, label="device")
    viewer: Any = Viewer()
    progress = Progress(scene, TrainConfig(iterations=10), renderer, tmp_path, viewer, lambda: None)
    monkeypatch.setattr(progress, "show", lambda: None)
    with progress.watching():
        for iteration in range(1, 6):
            progress.after({"iteration": iteration, "loss": 0.5, "num_gaussians": 7, "gaussians": None})
            now[0] += 1
        assert progress._bar is not None
        assert progress._bar.format_dict["elapsed"] == pytest.approx(5, abs=1)
