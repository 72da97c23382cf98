"""The self-test of a device: it passes with both variants of the stages, and finds a stage that computes wrong."""

import math
import os

import numpy as np
import pytest
from device_opening import open_device

from clsplat import ops, selftest
from clsplat.device import Device
from clsplat.stages import FUNCTIONS


@pytest.mark.parametrize("variants", ["cpu", "gpu"])
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_every_stage_agrees_with_its_twin(real, variants, monkeypatch):
    """By the launches and kernels for CPUs, and by those for GPUs, on whatever device there is."""
    monkeypatch.setenv("CLSPLAT_VARIANTS", variants)
    device = open_device(real)
    assert device.is_cpu == (variants == "cpu")
    assert selftest.faults(device) == {}


@pytest.mark.parametrize(("variants", "limit"), [("gpu", 32), ("cpu", 1)])
def test_every_stage_agrees_in_small_groups(monkeypatch, variants, limit):
    """On a device whose largest work-group is smaller than a tile, and than the groups of sorts and sums; and on a
    CPU that runs none of several work-items."""
    monkeypatch.setenv("CLSPLAT_VARIANTS", variants)
    device, launch = open_device(np.float32), Device.launch
    device.largest_group = limit  # shadows the cached property
    groups = []

    def launched(self, *arguments, group=None, **options):
        groups.append(group or ())
        launch(self, *arguments, group=group, **options)

    monkeypatch.setattr(Device, "launch", launched)
    assert selftest.faults(device) == {}
    assert {math.prod(group) for group in groups} <= set(range(limit + 1)) and len(groups) > 100


def test_small_groups_change_no_bit(monkeypatch):
    monkeypatch.setenv("CLSPLAT_VARIANTS", "gpu")
    images = []
    for limit in (256, 64):
        device = open_device(np.float32)
        device.largest_group = limit
        bench = selftest.Bench(device)
        image = ops.composite_fwd(device, bench.up(bench.splats), bench.lists(), selftest.BACKGROUND)
        images.append(image.rgb.get())
    np.testing.assert_array_equal(*images)


def test_every_stage_is_tested():
    modules = {getattr(ops, name).__module__.rsplit(".", 1)[1] for name in FUNCTIONS}
    assert set(selftest.TESTS) == modules


def test_a_stage_that_computes_wrong_is_named(device, monkeypatch):
    observe = selftest.reference.observe

    def wrong(*arguments):
        observe(*arguments)
        arguments[-1][3] += 1

    def failing(*arguments):
        raise RuntimeError("out of resources\nsecond line")

    monkeypatch.setattr(selftest.reference, "observe", wrong)
    monkeypatch.setattr(ops.scan, "queue_scan", failing)
    found = selftest.faults(device)
    out = "out of resources"
    assert found == {"observe": "expected errors below 0.0001, found 0.5", "scan": out, "march": out, "spheres": out}


def test_values_that_are_not_finite_or_missing_are_wrong():
    assert selftest.error_of(np.array([1.0, np.nan]), np.array([1.0, 2.0])) == np.inf
    assert selftest.error_of(np.array([1.0]), np.array([1.0, 2.0])) == np.inf
    assert selftest.error_of(np.array([1.0, 2.5]), np.array([1.0, 2.0])) == 0.25
    assert selftest.error_of(np.zeros(0), np.zeros(0)) == 0


def test_what_the_compiler_says_is_the_reason():
    said = "clBuildProgram failed\n\nBuild on a device:\n\ncl/scan.cl:3: error: undeclared\n(options)"
    assert selftest.reason(RuntimeError(said)) == "cl/scan.cl:3: error: undeclared"
    assert selftest.reason(RuntimeError()) == "RuntimeError"


def end(index, answers):
    os._exit(7)


def test_a_driver_that_ends_its_process_is_a_fault(monkeypatch):
    monkeypatch.setattr(selftest, "_report", end)
    assert selftest.faults_of(0) == {"device": "the driver ended the process (exit status 7)"}


def test_a_device_that_cannot_be_opened_is_a_fault():
    found = selftest.faults_of(10_000)
    assert list(found) == ["device"] and "index" in found["device"]
