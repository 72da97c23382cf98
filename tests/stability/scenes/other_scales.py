"""Experiment: a scene rendered at other scales than that of its photos."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from real_scenes import load

from clsplat.bench.stability.experiment import Experiment, Figure, Found, Plot
from clsplat.bench.stability.trained import trained
from clsplat.config import DataConfig, Mode, RenderConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.render import render_views
from clsplat.scene import View

SCALES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Scale of the focal length and of the image, relative to those of the training photos."""

VARIANTS: dict[str, tuple[Mode, bool]] = {
    "classic": ("classic", False),
    "2D filter": ("antialiased", False),
    "2D and 3D filter": ("antialiased", True),
}


def psnr_by_scale(
    gaussians: Gaussians, views: list[View], size: tuple[int, int], config: RenderConfig, device: Device
) -> list[float]:
    """Mean PSNR, dB, at each of SCALES.

    Parameters
    ----------
    gaussians : Gaussians
    views : list of View
        Photos, at least as large as the largest scale. Smaller ones are made from them by averaging over areas.
    size : tuple of int
        Width and height at scale 1, px.
    config : RenderConfig
    device : Device
    """
    result = []
    for scale in SCALES:
        width, height = (round(scale * edge) for edge in size)
        cameras = [view.camera.resized(width, height) for view in views]
        renders = render_views(gaussians, cameras, config, device)
        result.append(
            float(
                np.mean(
                    [
                        psnr(
                            to_uint8(r.rgb),
                            np.asarray(Image.fromarray(v.image).resize((width, height), Image.Resampling.BOX)),
                        )
                        for r, v in zip(renders, views, strict=True)
                    ]
                )
            )
        )
    return result


def scales(device: Device, data: Path) -> Found:
    """PSNR of held-out photos at each scale, per filter."""
    scene, config = load(data, "fern")
    large = load_scene(data / "fern", DataConfig(downscale=2)).test
    camera = scene.test[0].camera
    series: dict[str, list[tuple[float, float | None]]] = {}
    for label, (mode, filter_3d) in VARIANTS.items():
        variant = replace(config, render=RenderConfig(mode=mode), filter_3d=filter_3d)
        found = psnr_by_scale(
            trained(scene, variant, device), large, (camera.width, camera.height), variant.render, device
        )
        series[label] = list(zip(SCALES, found, strict=True))
    figures = [Figure(label, dict(points)[0.25] or 0.0, "dB") for label, points in series.items()]
    return Found(figures, Plot("scale, 1 is that of the photos", "PSNR of held-out photos, dB", series, "x"))


OTHER_SCALES = Experiment(
    failure="dilation and aliasing at other scales than the photos'",
    source="Mip-Splatting, Yu et al. 2024",
    remedy="opacity compensated for the dilation, `--mode antialiased`; no Gaussian thinner than the photos resolve, "
    "`--filter-3d`",
    test="tests/stability/test_scales.py::test_distance_does_not_change_the_mean_alpha",
    measure=scales,
    figure="PSNR of held-out photos of fern at a quarter of the scale, trained at 120x90, 500 iterations",
)
