"""Steps of the training loop of docs/howto/python.md beside those of `train`, with the same number of Gaussians.

``python tests/training/measure_own_loop.py DATASET [DOWNSCALE]`` prints the processor time of a step of both, as the
median of three alternated runs.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from clsplat import Device, Renderer, Scene, TrainConfig, prepare, train
from clsplat.config import AdcConfig, CoarseConfig, DataConfig
from clsplat.stages import Image
from clsplat.training import Adam, initialize

STEPS = 400


def own_loop(scene: Scene, config: TrainConfig, device: Device) -> None:
    """Train as the page says; the loss comes back every tenth step."""
    renderer = Renderer(device)
    adam = Adam(initialize(scene, config.init, seed=0), renderer, iterations=STEPS, extent=scene.extent)
    uploaded = [device.upload(view.name, view.image, np.uint8) for view in scene.train]
    order = np.random.default_rng(0)
    for step in range(STEPS):
        k = int(order.integers(len(scene.train)))
        camera = scene.train[k].camera
        run = renderer.forward(adam.gaussians, camera, adam.sh_degree)
        loss, v_rgb = renderer.stages.l1_ssim(run.image.rgb, uploaded[k], 0.2)
        v = renderer.backward(run, Image(v_rgb, renderer.no_alpha_gradient(camera)))
        adam.step(v.gaussians)
        if step % 10 == 9:
            float(loss)


def seconds(run: object, *arguments: object) -> float:
    """Processor time of a step, s."""
    assert callable(run)
    started = time.process_time()
    run(*arguments)
    return (time.process_time() - started) / STEPS


def main() -> None:
    """Measure, and print."""
    data = DataConfig(downscale=int(sys.argv[2]) if len(sys.argv) > 2 else 1)  # type: ignore[arg-type]
    fixed = AdcConfig(start=10**6)  # no rounds of growth
    config = TrainConfig(iterations=STEPS, size="fixed", strategy="adc", adc=fixed, eval_every=0, data=data)
    scene, config = prepare(sys.argv[1], replace(config, coarse=CoarseConfig(factor=1), checkpoint_every=10**6))
    device = Device()
    own_loop(scene, config, device)  # compiles
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(3):
        times[0].append(seconds(own_loop, scene, config, device))
        with TemporaryDirectory() as folder:
            times[1].append(seconds(train, scene, config, Path(folder) / "run", device))
    own, theirs = (1000 * median(t) for t in times)
    print(f"{len(scene.points)} Gaussians: {own:.2f} ms a step, train {theirs:.2f} ms, {own / theirs:.2f} times")


if __name__ == "__main__":
    main()
