"""Memory of a process that trains for hours under a viewer whose clients come and go: docs/howto/viewer.md.

``python tests/show/measure_soak.py --minutes 180 -o build/soak`` or ``make soak MINUTES=180``. It needs Linux, and
asserts that the memory does not grow and that the trained Gaussians have the bits of a training without a viewer.
"""

import asyncio
import json
import multiprocessing
import os
import random
import time
import warnings
from contextlib import suppress
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro
from small_scenes import cameras, small_training, views_of
from websocket_clients import camera_message, own
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

from clsplat.device import Device
from clsplat.renderer import Renderer
from clsplat.show.camera_paths import first_photo
from clsplat.show.viewer import Viewer

GROWTH_MAX = 64.0
"""Largest growth of the process after the first quarter of the time, MiB. In three hours, a hundred thousand clients
come and go: a leak of 1 kB each exceeds it, and what the allocator keeps of frames of many sizes does not."""

WINDOWS = ((64, 48), (320, 240), (1280, 960))
"""Sizes of the clients' windows, px. They are few, so that the device has kept its buffers for all of them early."""

ITERATIONS = 400
"""Iterations of a training. Trainings repeat until the time is over; each is compared with that without a viewer."""


async def visit(address: str, rng: random.Random) -> None:
    """One client: look around for a while, send nonsense at times, and leave with or without a word."""
    width, height = rng.choice(WINDOWS)
    client = await connect(**own(address))
    for _ in range(rng.randrange(6)):
        position = [rng.uniform(-1, 1), rng.uniform(-1, 1), -3.5]
        await client.send(camera_message(position=position, image_width=width, image_height=height))
        if rng.random() < 0.2:
            await client.send(rng.randbytes(rng.randrange(1, 2000)))
        with suppress(TimeoutError):
            await asyncio.wait_for(client.recv(), rng.uniform(0.01, 1.0))
    if rng.random() < 0.5:
        await client.close()
    else:
        client.transport.abort()


def visits(address: str) -> None:
    """Send clients, at most eight at a time, until this process is ended."""

    async def one_after_another(seed: int) -> None:
        rng = random.Random(seed)
        while True:
            with suppress(OSError, WebSocketException):
                await visit(address, rng)

    async def all_of_them() -> None:
        await asyncio.gather(*map(one_after_another, range(8)))

    asyncio.run(all_of_them())


def resident() -> float:
    """Resident memory of this process, MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def soak(minutes: float, out: Path) -> dict[str, Any]:
    """Train under a viewer for `minutes`, and write soak.json and soak.png to the folder `out`.

    Returns
    -------
    dict
        `samples`: lists of minutes, MiB and connected clients; `clients`: how many came; `trainings`; `growth`: from
        the second quarter of the time to the last, of the medians, MiB; `failures`: warnings of the viewer; `left`:
        clients that the viewer still held at the end.
    """
    device, cams = Device(), cameras()[1]
    viewer = Viewer(port=18080)
    viewer.show(Renderer(device), first_photo(cams), views_of(cams))
    came: set[int] = set()
    samples: list[tuple[float, float, int]] = []
    trainings, started = 0, time.monotonic()
    options = {"iterations": ITERATIONS}

    def progress(record: dict[str, Any]) -> None:
        came.update(viewer._clients)
        passed = (time.monotonic() - started) / 60
        if not samples or passed - samples[-1][0] > minutes / 1000:
            samples.append((passed, resident(), len(viewer._clients)))
        viewer.tell({"Iteration": str(record["iteration"])})
        viewer.follow(record["gaussians"], lambda: False)

    with TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.filterwarnings("always", "the viewer failed")
        alone = small_training(device, Path(folder) / "alone", **options).arrays()
        visitors = multiprocessing.get_context("spawn").Process(target=visits, args=(viewer.address,))
        visitors.start()
        started = time.monotonic()
        try:
            while time.monotonic() - started < 60 * minutes:
                beside = small_training(device, Path(folder) / f"beside{trainings}", progress, **options).arrays()
                assert all(np.array_equal(array, alone[name]) for name, array in beside.items()), "other bits"
                trainings += 1
        finally:
            visitors.terminate()
            visitors.join()
    end = time.monotonic() + 60
    while viewer._clients and time.monotonic() < end:
        time.sleep(0.1)
    report = {
        "minutes": minutes,
        "trainings": trainings,
        "clients": len(came),
        "left": len(viewer._clients),
        "growth": growth(samples),
        "growth_max": GROWTH_MAX,
        "failures": [str(w.message) for w in caught],
        "samples": samples,
    }
    viewer.close()
    out.mkdir(parents=True, exist_ok=True)
    (out / "soak.json").write_text(json.dumps(report) + "\n")
    draw(report, out / "soak.png")
    return report


def growth(samples: list[tuple[float, float, int]]) -> float:
    """Growth of the median memory from the second quarter of the time to the last, MiB."""
    whole = samples[-1][0]
    second = [memory for passed, memory, _ in samples if whole / 4 <= passed < whole / 2]
    last = [memory for passed, memory, _ in samples if passed >= 3 * whole / 4]
    return median(last) - median(second)


def draw(report: dict[str, Any], path: Path) -> None:
    """Chart of the memory over time, with the number of clients."""
    from matplotlib.figure import Figure

    passed, memory, clients = np.array(report["samples"]).T
    figure = Figure(figsize=(8, 4), layout="constrained")
    above, below = figure.subplots(2, sharex=True, height_ratios=[2, 1])
    above.plot(passed, memory)
    above.axvline(passed[-1] / 4, color="grey", linestyle=":")
    above.set(ylim=(0, None), ylabel="memory, MiB")
    above.set_title(
        f"{report['trainings']} trainings, {report['clients']} clients; from the second to the last quarter "
        f"{report['growth']:+.1f} MiB (allowed {report['growth_max']:+.0f})",
        fontsize="medium",
    )
    below.plot(passed, clients, linewidth=0.5)
    below.set(xlabel="time, minutes", ylabel="clients")
    figure.savefig(path, dpi=120)


def check(report: dict[str, Any]) -> None:
    """Assert what a soak must show."""
    assert report["growth"] < GROWTH_MAX, f"the memory grew by {report['growth']:.1f} MiB"
    assert report["clients"] > 10 * report["minutes"], "too few clients came to show anything"
    assert report["left"] == 0 and report["failures"] == []


def main(minutes: float = 180, out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("build/soak")) -> None:
    """Train under a viewer for hours, and check its memory.

    Parameters
    ----------
    minutes
        Time to train.
    out
        Folder for soak.json and soak.png.
    """
    report = soak(minutes, out)
    print({name: value for name, value in report.items() if name != "samples"})
    check(report)


if __name__ == "__main__":
    tyro.cli(main)
