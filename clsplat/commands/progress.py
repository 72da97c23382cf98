"""Training with a progress bar, which begins with the first step, and with the viewer if there is one."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clsplat.commands.console import STARTED, Terminated, say, warn

if TYPE_CHECKING:
    from tqdm import tqdm

    from clsplat.config import TrainConfig
    from clsplat.gaussians import Gaussians
    from clsplat.renderer import Renderer
    from clsplat.scene import Scene
    from clsplat.show.viewer import Viewer

WAITING = "compiling kernels, which are kept for the next run, adding points, and waiting for the first step"
"""Text of the progress bar before the first step. Drivers compile some kernels only when they first run."""

PAUSE = 1.0
"""Time of the viewer between two steps, s, above which the estimate of the bar leaves it out: the training was
paused, or kernels were compiled for the first frame."""


class Stop:
    """Ctrl-C and SIGTERM, which batch systems send: they end a training after an iteration, not within it.

    Parameters
    ----------
    out : Path
        Folder of the run.

    Attributes
    ----------
    asked : threading.Event
        Set when a signal has come.
    """

    def __init__(self, out: Path):
        self._out, self._terminated, self.asked = out, False, threading.Event()

    @contextmanager
    def awaited(self) -> Iterator[None]:
        """Keep the first signal for `after` in the block; a second one does not wait."""
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

        def interrupt(number: int, _: object) -> None:
            self._terminated |= number == signal.SIGTERM
            self.asked.set()
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, before[signal.SIGTERM])

        for number in before:
            signal.signal(number, interrupt)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def after(self, iteration: int) -> None:
        """Raise KeyboardInterrupt if a signal has come; it is `Terminated` for SIGTERM."""
        if self.asked.is_set():
            warn(f"{self._out}: stopped after iteration {iteration}")
            raise Terminated if self._terminated else KeyboardInterrupt


class Progress:
    """The bar, the viewer's panel, and Ctrl-C and SIGTERM of one training.

    Parameters
    ----------
    scene : Scene
    config : TrainConfig
    renderer : Renderer
    out : Path
        Folder of the run.
    viewer : Viewer or None
    began : callable
        Called after the first step.
    """

    def __init__(
        self,
        scene: "Scene",
        config: "TrainConfig",
        renderer: "Renderer",
        out: Path,
        viewer: "Viewer | None",
        began: Callable[[], None],
    ):
        self._scene, self._config, self._renderer, self._viewer = scene, config, renderer, viewer
        self._began, self._shown = began, False
        self._bar: tqdm[Any] | None = None
        self._begun = threading.Event()
        self._waits = threading.Thread(target=self._wait, daemon=True)
        self._stop = Stop(out)
        self._facts: dict[str, str] = {}  # lines of the viewer's panel
        self._psnr: float | None = None

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Show in the block what the training waits for and then its progress.

        Ctrl-C and SIGTERM end it after an iteration.
        """
        if self._viewer:
            self._viewer.wait(WAITING)
        self._waits.start()
        try:
            with self._stop.awaited():
                yield
        finally:
            self._end_wait()
            if self._bar is not None:
                self._bar.close()

    def _end_wait(self) -> None:
        """Remove the line about what the training waits for."""
        self._begun.set()
        self._waits.join()

    def _wait(self) -> None:
        """Say what the training waits for; on a terminal, count the seconds."""
        from tqdm import tqdm

        if not sys.stderr.isatty():
            say(WAITING)
            return
        with tqdm(bar_format="{desc} {elapsed}", desc=WAITING, leave=False) as line:
            while not self._begun.wait(1):
                line.refresh()

    def after(self, record: dict[str, Any]) -> None:
        """Report an iteration; the argument `progress` of `clsplat.training.loop.train`."""
        if self._bar is None:
            self._start(record)
        assert self._bar is not None
        self._bar.update(record["iteration"] - self._bar.n)
        self._bar.set_postfix_str(f"loss={record['loss']:.4f}, N={record['num_gaussians']}", refresh=False)
        if self._viewer:
            self._facts["Iteration"] = f"{record['iteration']:,} of {self._config.iterations:,}"
            self._facts["Gaussians"], self._facts["Loss"] = f"{record['num_gaussians']:,}", f"{record['loss']:.4f}"
            self._viewer.tell(self._facts)
            self._viewer.record(record["iteration"], record["num_gaussians"], self._psnr)
            self._psnr = None
            started = time.perf_counter()
            self._viewer.follow(record["gaussians"], self._stop.asked.is_set)
            if time.perf_counter() - started > PAUSE:
                self._bar.unpause()
        self._stop.after(record["iteration"])

    def _start(self, record: dict[str, Any]) -> None:
        """Replace what the training waited for by a bar, whose estimate does not contain the wait."""
        from tqdm import tqdm

        self._end_wait()  # two bars would take two lines
        say(f"first iteration: done {time.perf_counter() - STARTED:.1f} s after the start")
        first = record["iteration"]
        self._bar = tqdm(total=self._config.iterations, initial=first, unit="it", dynamic_ncols=True)
        self.show()
        self._began()

    def show(self) -> None:
        """Show the scene in the viewer, once. An error of the viewer does not end a training."""
        if self._viewer is None or self._shown:
            return
        from clsplat.show.camera_paths import first_photo

        self._shown = True
        try:
            start = first_photo([view.camera for view in self._scene.train])
            self._viewer.show(self._renderer, start, self._scene.train)
        except Exception as error:
            warn(f"warning: the viewer failed: {type(error).__name__}: {error}")

    def held_out(self, gaussians: "Gaussians") -> dict[str, float]:
        """Evaluate the held-out photos; the argument `evaluate` of `clsplat.training.loop.train`."""
        from clsplat.evaluate import mean_metrics

        means = mean_metrics(gaussians, self._scene.test, self._renderer)
        self._psnr = means["psnr"]
        self._facts["Held-out photos"] = ", ".join(f"{name.upper()} {value:.4g}" for name, value in means.items())
        return means


def train_with_progress(
    scene: "Scene",
    config: "TrainConfig",
    renderer: "Renderer",
    out: Path,
    resume: bool,
    viewer: "Viewer | None",
    began: Callable[[], None],
) -> "Gaussians":
    """Train with a progress bar and, if there is one, a viewer; `began` is called after the first step."""
    from clsplat.training.loop import train

    progress = Progress(scene, config, renderer, out, viewer, began)
    with progress.watching():
        gaussians = train(
            scene,
            config,
            out,
            renderer.device,
            resume=resume,
            evaluate=progress.held_out if scene.test else None,
            progress=progress.after,
        )
    progress.show()  # a finished run that is resumed has no step
    return gaussians
