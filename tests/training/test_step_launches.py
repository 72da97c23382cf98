"""What a training step asks of the host: the number of launches and of reads that wait."""

from pathlib import Path
from typing import Any

import pyopencl as cl
import pytest
from test_memory import FIXED_N, make_scene

from clsplat.bench.timing import STILL
from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.training.loop import train

STEPS = 8


@pytest.mark.parametrize("variants", ["cpu", "gpu"])
def test_a_step_takes_few_launches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variants: str) -> None:
    """At most 31, with more tiles than one digit of the sort has, and lists longer than the bitonic sort takes."""
    monkeypatch.setenv("CLSPLAT_VARIANTS", variants)
    launched: list[list[str]] = [[]]
    launch = Device.launch

    def counted(self: Device, stage: str, kernel: str, *arguments: object, **options: object) -> None:
        launched[-1].append(kernel)
        launch(self, stage, kernel, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Device, "launch", counted)
    config = TrainConfig(strategy="adc", size="fixed", iterations=STEPS, adc=FIXED_N, eval_every=0)
    train(make_scene(2000, 288, 256), config, tmp_path, Device(), progress=lambda _: launched.append([]))
    for step in launched[1:-2]:  # the first prepares, and after the last the scene is finished
        assert len(step) <= 31, step
        assert step.count("composite_pack") == 1 and step.count("composite_bwd") == 1
    expected = 2 * (4 + 2) if variants == "gpu" else 2 * 3  # passes of the sorts by depth and by tile
    assert sum(kernel in ("sort_count", "sort_scatter") for kernel in launched[2]) == expected


@pytest.mark.parametrize("variants", ["cpu", "gpu"])
def test_the_device_has_work_while_the_host_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variants: str
) -> None:
    """Each read of a step was queued before kernels that follow it, and nothing else waits."""
    monkeypatch.setenv("CLSPLAT_VARIANTS", variants)
    events: list[list[str]] = [[]]
    launch, wait = Device.launch, cl.Event.wait

    def launched(self: Device, stage: str, kernel: str, *arguments: object, **options: object) -> None:
        events[-1].append(kernel)
        launch(self, stage, kernel, *arguments, **options)  # type: ignore[arg-type]

    def waited(self: cl.Event) -> None:
        events[-1].append("wait")
        wait(self)

    def copied(*arguments: Any, **options: Any) -> cl.Event:
        blocking = options.get("is_blocking", True)
        events[-1].append("blocking copy" if blocking else "copy")
        return copy(*arguments, **options)

    copy = cl.enqueue_copy
    monkeypatch.setattr(Device, "launch", launched)
    monkeypatch.setattr(cl.Event, "wait", waited)
    monkeypatch.setattr(cl, "enqueue_copy", copied)
    config = TrainConfig(strategy="adc", size="fixed", iterations=STEPS, adc=FIXED_N, eval_every=0)
    train(make_scene(2000, 288, 256), config, tmp_path, Device(), progress=lambda _: events.append([]))
    for step in events[4:-2]:  # the first four upload their photos, and after the last the scene is finished
        assert "blocking copy" not in step
        assert step.count("copy") == step.count("wait") == 2
        for _ in range(2):
            read, until = step.index("copy"), step.index("wait")
            assert read < until - 1, step
            step = step[until + 1 :]


@pytest.mark.parametrize("variants", ["cpu", "gpu"])
def test_a_step_allocates_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variants: str) -> None:
    """Once every photo was seen, and while no list grows, all buffers come from those of earlier steps."""
    monkeypatch.setenv("CLSPLAT_VARIANTS", variants)
    device, managed = Device(), []

    def count(_: object) -> None:
        pool = device.buffers.pool
        managed.append((pool.active_blocks + pool.held_blocks, pool.managed_bytes))

    config = TrainConfig(strategy="adc", size="fixed", iterations=2 * STEPS, adc=FIXED_N, eval_every=0, optim=STILL)
    train(make_scene(2000, 288, 256), config, tmp_path, device, progress=count)
    assert len(set(managed[STEPS : 2 * STEPS - 1])) == 1
    assert managed[0] != managed[STEPS]  # the first steps did allocate


def test_splats_are_packed_again_where_they_are_others(device: Device) -> None:
    first, second = (device.upload("x", [1.0, 2.0]) for _ in range(2))
    result = device.upload("y", [3.0])
    device.keep("test", (first, second), result)
    assert device.kept("test", (first, second)) is result
    assert device.kept("test", (first, first)) is None
    assert device.kept("test", (first,)) is None
    assert device.kept("other", (first, second)) is None
    del first
    assert "test" not in device._kept  # its memory is free
