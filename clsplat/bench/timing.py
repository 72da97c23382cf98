"""Clocks, quartiles of their readings, and the training step that is timed."""

import time

import numpy as np
from numpy.typing import NDArray

from clsplat.bench.workloads import Workload
from clsplat.config import OptimConfig, TrainConfig
from clsplat.device import Device
from clsplat.scene import Scene
from clsplat.training.densify import STRATEGIES
from clsplat.training.optimizer import Moments
from clsplat.training.rows import Rows
from clsplat.training.session import Training, step
from clsplat.training.state import State

ITERATION = 3001
"""Iteration of a default run that is timed: it trains all bands of the spherical harmonics and collects the
statistics of densification, and no edit is due."""

STILL = OptimConfig(1e-30, 1e-30, 1e-30, 1e-30, 1e-30, 1e-30, 1e-30)
"""Learning rates that change no parameter, so that all steps of a measurement do the same work."""

# Wall time and CPU time of the process, s.
Clock = NDArray[np.float64]


def clock() -> Clock:
    """Current readings of both clocks."""
    return np.array([time.perf_counter(), time.process_time()])


def quartiles(samples: list[Clock], cores: int | None) -> dict[str, float]:
    """Median and quartiles of wall times, ms. If the device is the host's CPU, also the median CPU time per core."""
    wall, cpu = 1e3 * np.array(samples).T
    q1, median, q3 = np.percentile(wall, [25, 50, 75])
    result = {"median_ms": median, "q1_ms": q1, "q3_ms": q3}
    if cores is not None:
        result["cpu_ms"] = float(np.median(cpu)) / cores
    return {key: round(float(value), 4) for key, value in result.items()}  # to 0.1 us


def training_of(workload: Workload, config: TrainConfig, device: Device) -> Training:
    """A training on the photo of a workload, before the iteration `ITERATION`."""
    strategy = STRATEGIES[config.strategy](config, workload.extent, len(workload.gaussians))
    rows = Rows(workload.gaussians, Moments.zeros(workload.gaussians), strategy)
    scene = Scene([workload.view], [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    training = Training(scene, config, device, State(ITERATION - 1, 0.0, workload.extent, rows))
    training.state.move(training.optimizer.home)
    training.photos.keep_within(4 * workload.view.image.nbytes)  # the photo and its mask stay on the device
    return training


def run_step(training: Training) -> None:
    """Run one step of a training, to its end on the device; each call does the same work."""
    training.state.iteration = ITERATION - 1
    step(training, training.scene.train[0])
    training.device.queue.finish()
