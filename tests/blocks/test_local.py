"""Blocks in processes of this machine: the same bytes as one after the other, and errors in a sentence."""

import os
import subprocess
import sys

import pytest
from small_plan import Planned, unseen

from clsplat.blocks import local
from clsplat.blocks.block import result_of
from clsplat.blocks.local import devices_like, run_on_devices
from clsplat.blocks.whole import run_here
from clsplat.commands import blockwise
from clsplat.commands.options import ClusterOptions
from clsplat.device import Device
from clsplat.errors import ClsplatError


def test_processes_make_the_same_bytes(planned: Planned, device: Device) -> None:
    """One device stands for two."""
    (number,) = devices_like(device)
    said: list[str] = []
    run_on_devices(planned.jobs, [number, number], said.append)
    assert [line[:20] for line in said] == ["blocks: 1 of 2 done,", "blocks: 2 of 2 done,"]
    assert {line[-len("device 1 of 2") :] for line in said} == {"device 1 of 2", "device 2 of 2"}
    found = [result_of(job).read_bytes() for job in planned.jobs]
    for job in planned.jobs:
        result_of(job).unlink()
    run_here(planned.jobs, planned.scene, device, unseen)
    assert [result_of(job).read_bytes() for job in planned.jobs] == found
    run_on_devices(planned.jobs, [number], pytest.fail)  # nothing is left to do


def test_an_error_in_a_process_is_told_and_stops_the_others(planned: Planned, device: Device) -> None:
    planned.jobs[1].write_text("{}")
    with pytest.raises(ClsplatError, match=rf"block {planned.jobs[1].stem}: its process ended with status 1: .*job"):
        run_on_devices(planned.jobs, [*devices_like(device), *devices_like(device)], lambda text: None)


def test_processes_end_with_an_interruption(
    planned: Planned, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = local._started

    def noted(*arguments: object) -> object:
        running = start(*arguments)  # type: ignore[arg-type]
        started.append(running.process)
        return running

    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(local, "_started", noted)
    monkeypatch.setattr("clsplat.blocks.local.time.sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_on_devices(planned.jobs, devices_like(device), lambda text: None)
    assert [process.poll() for process in started] == [-9]


def test_several_devices_of_a_name_are_used_without_a_scheduler(
    planned: Planned, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[list[int]] = []
    monkeypatch.setattr(local, "devices_like", lambda device: [0, 3])
    monkeypatch.setattr(local, "run_on_devices", lambda jobs, devices, tell: used.append(devices))
    blockwise._run(planned.jobs, planned.scene, device, unseen, ClusterOptions())
    assert used == [[0, 3]]


def test_devices_are_alike_by_their_labels(device: Device) -> None:
    """PoCL makes as many devices of the processor as it is told to."""
    if not device.label.startswith("Portable Computing Language"):
        pytest.skip("needs PoCL")
    code = "from clsplat.blocks.local import devices_like as a; from clsplat.device import Device; print(a(Device()))"
    environment = os.environ | {"POCL_DEVICES": "pthread pthread"}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[0, 1]"
