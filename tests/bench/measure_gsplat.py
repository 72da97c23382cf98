"""Time gsplat's CUDA kernels and clsplat's on the same GPU, scenes and views, alternately.

gsplat's step is its forward and backward pass and Adam as in its trainer, without a loss: the gradient of the image
is given. clsplat's step is a whole training step, with the loss. Both show the same image; the difference is printed.
Needs torch with CUDA, and gsplat: pip install torch gsplat.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gsplat
import numpy as np
import torch

from clsplat.bench.timing import run_step, training_of
from clsplat.bench.workloads import Workload, synthetic
from clsplat.config import SHORT_RUN, RenderConfig, TrainConfig
from clsplat.device import Device, select_device
from clsplat.renderer import Renderer


def gsplat_steps(workload: Workload) -> tuple[Callable[[], Any], Callable[[], None]]:
    """The forward pass, which returns the image, and a step of gsplat on a workload."""
    g, camera = workload.gaussians, workload.view.camera
    values = [g.means, g.quats, g.log_scales, g.logit_opacities, g.sh[:, :1], g.sh[:, 1:]]
    parameters = [torch.tensor(np.ascontiguousarray(a), device="cuda", requires_grad=True) for a in values]
    K = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], device="cuda")
    viewmat = torch.tensor(camera.viewmat, dtype=torch.float32, device="cuda")
    shape = (1, camera.height, camera.width, 3)
    v_image = torch.randn(shape, device="cuda") / np.prod(shape)
    # The rate changes nothing, so that all steps do the same work.
    optimizers = [torch.optim.Adam([p], lr=1e-30, eps=1e-15, fused=True) for p in parameters]

    def image() -> Any:
        means, quats, log_scales, logits, sh0, rest = parameters
        return gsplat.rasterization(
            *(means, quats, log_scales.exp(), logits.sigmoid(), torch.cat([sh0, rest], 1)),
            *(viewmat[None], K[None].float(), camera.width, camera.height),
            sh_degree=3,
            packed=False,
        )[0]

    def forward() -> Any:
        with torch.no_grad():
            result = image()
        torch.cuda.synchronize()
        return result

    def step() -> None:
        image().backward(v_image)
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        torch.cuda.synchronize()

    return forward, step


def clsplat_steps(workload: Workload, device: Device) -> tuple[Callable[[], Any], Callable[[], None]]:
    """The forward pass and a training step of clsplat on a workload."""
    config = TrainConfig(strategy="adc", size="fixed", iterations=SHORT_RUN)
    training = training_of(workload, config, device)
    renderer = Renderer(device, RenderConfig())
    gaussians = renderer.place(workload.gaussians)

    def forward() -> Any:
        result = renderer.forward(gaussians, workload.view.camera, gradients=False)
        device.queue.finish()
        return result.image.rgb

    return forward, lambda: run_step(training)


def main() -> None:
    """Measure and print; --out writes JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workloads", nargs="+", default=["100k-640x480", "1M-640x480", "1M-1920x1080"])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device")
    parser.add_argument("-o", "--out", type=Path)
    arguments = parser.parse_args()
    device = Device(select_device(arguments.device))
    print(f"{device.label}; gsplat {gsplat.__version__}, torch {torch.__version__} on {torch.cuda.get_device_name()}")
    rows = []
    for name in arguments.workloads:
        workload = synthetic(name)
        ours, theirs = clsplat_steps(workload, device), gsplat_steps(workload)
        difference = np.abs(ours[0]().get() - theirs[0]()[0].cpu().numpy()).mean()
        times: dict[str, list[float]] = {}
        for repeat in range(arguments.repeats + 2):
            for who, pair in (("clsplat", ours), ("gsplat", theirs)):
                for what, run in zip(("forward", "step"), pair, strict=True):
                    start = time.perf_counter()
                    run()
                    if repeat >= 2:  # the first ones build kernels and fill pools
                        times.setdefault(f"{who} {what}", []).append(1e3 * (time.perf_counter() - start))
        rows.append({"workload": name, "mean_difference": float(difference)})
        rows[-1] |= {key: float(np.median(values)) for key, values in times.items()}
        print(", ".join(f"{k}: {v:.3g}" if isinstance(v, float) else v for k, v in rows[-1].items()), flush=True)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps({"device": device.label, "gsplat": gsplat.__version__, "rows": rows}))


if __name__ == "__main__":
    main()
