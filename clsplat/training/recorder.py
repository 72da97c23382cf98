"""Records of a training: its log, its checkpoints, its evaluations, and its training time."""

import time
import warnings
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.resuming import CHECKPOINT
from clsplat.run_log import LOG_EVERY, Append
from clsplat.training.checkpoint import save_state
from clsplat.training.divergence import check_loss, check_state
from clsplat.training.session import Training


class Recorder:
    """Log, checkpoints and evaluations after the iterations of a training.

    Parameters
    ----------
    training : Training
    out : Path
        Folder of the checkpoint.
    log : callable
        Append a record to the log.
    progress, evaluate, evaluate_after
        As given to `clsplat.training.loop.train`.
    """

    def __init__(
        self,
        training: Training,
        out: Path,
        log: Append,
        progress: Append,
        evaluate: Callable[[Gaussians], dict[str, float]] | None,
        evaluate_after: Container[int] | None,
    ):
        self._training, self._out, self._log, self._progress = training, out, log, progress
        config = training.config
        if evaluate_after is None:
            every = config.eval_every
            evaluate_after = {*range(every, config.iterations, every), config.iterations} if every else ()
        self._evaluate, self._evaluate_after = evaluate, evaluate_after
        self._started = time.perf_counter() - training.state.seconds

    def after(self, training: Training, loss: float) -> None:
        """Record an iteration of the training itself."""
        state, config = training.state, training.config
        check_loss(loss, state.iteration, self._out)
        state.losses.append(loss)
        # Virtual machines exist whose clock has gone back; a time is never less than an earlier one.
        state.seconds = max(state.seconds, time.perf_counter() - self._started)
        if state.iteration < config.iterations:  # the last line is about the scene as it is saved
            self._line(state.shown(training.renderer) if state.iteration in self._evaluate_after else None)
        if state.iteration == config.iterations:
            self._save_last()
        elif state.iteration % config.checkpoint_every == 0:
            self._save()
        self._tell(training, loss)

    def end(self, gaussians: Gaussians) -> None:
        """Log the end of a run, whose scene has been finished. A run that is resumed after its end logs it again."""
        self._line(gaussians if self._training.config.iterations in self._evaluate_after else None, gaussians)

    def _line(self, evaluated: Gaussians | None, finished: Gaussians | None = None) -> None:
        """Log an iteration, if it is one of those with a line or is evaluated."""
        state = self._training.state
        record: dict[str, Any] = {}
        if state.iteration % LOG_EVERY == 0 or finished is not None:
            record = {"loss": float(np.mean(state.losses))}
            if finished is None:
                state.losses.clear()
        if self._evaluate and evaluated is not None:
            record |= self._evaluate(evaluated)
            self._started = time.perf_counter() - state.seconds
        if record:
            count = len(state.gaussians if finished is None else finished)
            self._log({"iteration": state.iteration, "num_gaussians": count, "seconds": state.seconds} | record)

    def after_fork(self, fork: Training, loss: float) -> None:
        """Report an iteration of a fork, which is neither logged nor saved."""
        self._tell(fork, loss)

    def _tell(self, shown: Training, loss: float) -> None:
        state = self._training.state
        about = {"iteration": state.iteration, "loss": loss, "num_gaussians": len(shown.state.gaussians)}
        gaussians = shown.state.shown(shown.renderer) if shown.state.filter else shown.state.gaussians
        left = time.perf_counter()
        try:
            self._progress(about | {"gaussians": gaussians})
        except KeyboardInterrupt:
            self._save()
            raise
        self._started += time.perf_counter() - left

    def _save_last(self) -> None:
        """Save the state after the last iteration. The scene, which is smaller, may fit where this does not."""
        try:
            self._save()
        except InputError as error:
            warnings.warn(f"{error}; the scene is written next, without it", stacklevel=2)

    def _save(self) -> None:
        training = self._training
        check_state(training.state, training.renderer.stages, self._out)
        training.state.inputs = training.state.inputs.completed(training.scene)
        save_state(self._out / CHECKPOINT, training.state, training.config)
