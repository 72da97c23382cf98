"""Measure what depth maps do for few photos of the still life: python tests/training/measure_depths.py.

Run it with PYTHONPATH=.:tests:tests/training:tests/commands. Six photos of 160x120 train for --iterations, from 600
points; three others are compared with the scene, and its depths in them with the true ones. The maps are inverse
depths with smooth errors of 3 %, of another scale and shift in each photo.
"""

import argparse
import tempfile
from dataclasses import replace

import numpy as np
from test_depths import depth_error, estimated

from clsplat.config import OptimConfig, TrainConfig
from clsplat.dataset.depth_maps import aligned
from clsplat.dataset.near_planes import with_near_planes
from clsplat.demo.known_photos import known_scene
from clsplat.demo.still_life import still_life
from clsplat.evaluate import mean_metrics
from clsplat.renderer import Renderer, default_device
from clsplat.training.few_views import adapted
from clsplat.training.loop import train

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--iterations", type=int, default=1000)
parser.add_argument("--cameras", type=int, default=1, help="seed of the cameras")
parser.add_argument("--seeds", type=int, default=3, help="number of trainings of each kind")
parser.add_argument("--weights", type=float, nargs=2, default=(1.0, 0.1), help="at the start and at the end")
given = parser.parse_args()

solids, rng, device = still_life(), np.random.default_rng(0), default_device()
plain = known_scene(24, 160, 120, points=600, seed=given.cameras)
plain = with_near_planes(replace(plain, train=plain.train[::4]))
deep = aligned(replace(plain, train=[estimated(view, solids, rng) for view in plain.train]), print)
print(device.label)
for seed in range(given.seeds):
    for name, scene in (("without", plain), ("with maps", deep)):
        optim = OptimConfig(depth_weight=given.weights[0], depth_weight_final=given.weights[1])
        config = adapted(TrainConfig(iterations=given.iterations, eval_every=0, seed=seed, optim=optim), scene)
        with tempfile.TemporaryDirectory() as folder:
            gaussians = train(scene, config, folder, device)
        psnr = mean_metrics(gaussians, scene.test, Renderer(device))["psnr"]
        print(f"seed {seed} {name}: {psnr:.2f} dB, depth error {depth_error(gaussians, scene, solids, device):.1%}")
