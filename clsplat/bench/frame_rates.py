"""Frame rates of the viewer: frames while the camera moves, and at fixed resolutions, each with its JPEG."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

from clsplat.bench.environment import describe
from clsplat.bench.timing import Clock, clock, quartiles
from clsplat.bench.workloads import Workload
from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.show.camera_paths import around
from clsplat.show.frames import picture
from clsplat.show.pacing import JPEG_QUALITY, Client

SHARES = (1.0, 0.5, 0.25)
"""Resolutions that are timed, as fractions of the window's edges."""

WARM_UP = 15
"""Frames before those that are timed: kernels are compiled, and the resolution is found."""

TURN = 360
"""Frames of a whole turn around the scene: a degree per frame, as the mouse moves it."""


def bench_frames(
    workloads: list[Workload], device: Device, frames: int, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Time the frames of the viewer.

    Parameters
    ----------
    workloads : list of Workload
    device : Device
    frames : int
        Number of timed frames of each kind.
    tell : callable
        Called with the name of each workload.

    Returns
    -------
    dict
        environment, and for each of the workloads its name, ``moving`` and ``shares`` by resolution: times, ms, as of
        `clsplat.bench.timing.quartiles`, and the mean share of the window's edges while the camera moves.
    """
    cores = device.cl_device.max_compute_units if device.is_cpu else None
    renderer, rows = Renderer(device), []
    for workload in workloads:
        tell(workload.name)
        gaussians = renderer.place(workload.gaussians)
        first = workload.view.camera
        centre = np.median(workload.gaussians.means, axis=0)
        path = around(first, centre.astype(np.float64), -first.viewmat[1, :3], TURN)
        client, moving, shares = Client(None), [], []
        for number in range(WARM_UP + frames):
            took = _frame(renderer, gaussians, _scaled(path[number % TURN], client.share))
            if number >= WARM_UP:
                moving.append(took)
                shares.append(client.share)
            client.adapt(float(took[0]))
        fixed = {}
        for share in SHARES:
            camera = _scaled(first, share)
            _frame(renderer, gaussians, camera)
            fixed[str(share)] = quartiles([_frame(renderer, gaussians, camera) for _ in range(frames)], cores)
        rows.append(
            {
                "name": workload.name,
                "moving": {**quartiles(moving, cores), "share": round(float(np.mean(shares)), 3)},
                "shares": fixed,
            }
        )
    return {"environment": describe(device), "frames": frames, "workloads": rows}


def _scaled(camera: Camera, share: float) -> Camera:
    return camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))


def _frame(renderer: Renderer, gaussians: Gaussians, camera: Camera) -> Clock:
    """Times of one frame, s."""
    started = clock()
    Image.fromarray(picture(renderer, gaussians, camera)[0]).save(io.BytesIO(), "JPEG", quality=JPEG_QUALITY)
    return clock() - started


def frames_text(results: dict[str, Any]) -> str:
    """Table of the results as Markdown, with the environment below it."""
    names = [str(share) for share in SHARES]
    head = [
        "Gaussians and window",
        "frames per second while moving",
        "at",
        *(f"{name} of edges" for name in names),
    ]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for row in results["workloads"]:
        moving = row["moving"]
        cells = [f"{1000 / moving['median_ms']:.0f}", f"{moving['share']:.2f} of edges"]
        cells += [_time(row["shares"][name]) for name in names]
        lines.append(f"| {row['name']} | {' | '.join(cells)} |")
    environment = results["environment"]
    device, software = environment["device"], environment["software"]
    per_core = ", and the processor time per core in brackets" if device["kind"] == "cpu" else ""
    lines.append(
        f"\nTimes are those of a frame and its JPEG: the median{per_core}. {device['label']}, "
        f"{device['compute_units']} compute units, {environment['date'][:10]}, commit "
        f"{(software['commit'] or 'unknown')[:7]}, load average {environment['load']} at the start."
    )
    return "\n".join(lines)


def _time(times: dict[str, float]) -> str:
    return f"{times['median_ms']:.0f} ms" + (f" ({times['cpu_ms']:.0f})" if "cpu_ms" in times else "")
