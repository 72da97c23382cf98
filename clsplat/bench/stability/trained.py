"""Trainings whose only result is an evaluation: their files are not kept."""

from tempfile import TemporaryDirectory

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.device import Device
from clsplat.evaluate import Metric, mean_metrics
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr
from clsplat.renderer import Renderer
from clsplat.scene import Scene
from clsplat.training.loop import train


def trained(scene: Scene, config: TrainConfig, device: Device) -> Gaussians:
    """Train in a temporary folder and return the Gaussians."""
    with TemporaryDirectory() as out:
        return train(scene, config, out, device)


def held_out(gaussians: Gaussians, scene: Scene, config: TrainConfig, device: Device, metric: Metric = psnr) -> float:
    """Mean of `metric` over the held-out photos; by default the PSNR, dB."""
    background = BACKGROUNDS[config.data.background]
    renderer = Renderer(device, config.render, background)
    return mean_metrics(gaussians, scene.test, renderer, (metric,))[metric.__name__]
