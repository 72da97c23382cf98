"""The limits of a device, by kernels that do nothing else."""

import math

import numpy as np
import pytest

from clsplat.bench import roof
from clsplat.device import Device


class TestRoof:
    @pytest.mark.parametrize("width", [1, 4, 16])
    @pytest.mark.parametrize(
        ("kernel", "scalars", "fixpoint"),
        [("roof_fma", [0.5, 0.5], 1.0), ("roof_exp", [], 0.5671432904), ("roof_exp2", [], 0.6411857445)],
    )
    def test_recurrences_reach_their_fixpoint(self, device, width, kernel, scalars, fixpoint):
        out = device.upload("out", np.zeros(6 * width))
        device.launch("roof", kernel, (6,), [80, *scalars, out], defines=roof.defines(device, width), group=(1,))
        np.testing.assert_allclose(out.get(), roof.CHAINS * fixpoint, rtol=1e-5)

    @pytest.mark.parametrize("step", [1, 6])
    @pytest.mark.parametrize("width", [4, 16])
    def test_every_number_is_moved(self, device, step, width):
        a = np.arange(6 * 5 * width, dtype=np.float32)
        arrays = [device.upload("a", a), device.upload("b", 2 * a), device.upload("y", 0 * a)]
        defines = roof.defines(device, width)
        device.launch("roof", "roof_triad", (6,), [5, step, 0.5, *arrays], defines=defines, group=(1,))
        np.testing.assert_array_equal(arrays[2].get(), 2 * a)
        device.launch("roof", "roof_copy", (6,), [5, step, *arrays[1:]], defines=defines, group=(1,))
        np.testing.assert_array_equal(arrays[2].get(), 2 * a)
        device.launch("roof", "roof_copy", (6,), [5, step, arrays[0], arrays[2]], defines=defines, group=(1,))
        np.testing.assert_array_equal(arrays[2].get(), a)

    def test_everything_is_measured(self, configured_device, quick_roof):
        measured = roof.measure_roof(configured_device)
        assert all(math.isfinite(value) and value > 0 for value in measured.values()), measured
        assert 0.5 < measured["buffer_mib"] <= 1

    def test_groups_are_as_small_as_the_device_demands(self, quick_roof, monkeypatch):
        device, groups = Device(), []
        monkeypatch.setattr(device, "is_cpu", False)
        monkeypatch.setattr(device, "largest_group", 64)
        launch = device.launch
        monkeypatch.setattr(
            device, "launch", lambda *a, group, **b: groups.append(group) or launch(*a, group=group, **b)
        )
        roof.measure_roof(device)
        assert set(groups) == {(1,), (64,)}

    def test_rates_are_work_over_time(self, device, monkeypatch):
        monkeypatch.setattr(roof, "_best", lambda device, run, runs: 2.0)  # every run takes 2 s
        measured = roof.measure_roof(device)
        items = (
            4 * device.cl_device.max_compute_units * 16
            if device.is_cpu
            else 2048 * device.cl_device.max_compute_units
        )
        assert measured["fma_gflops"] == pytest.approx(2e-9 * items * 16 * 64 / 2)
        assert measured["exp_gops"] == measured["exp2_gops"] == pytest.approx(1e-9 * items * 16 * 64 / 2)
        assert measured["copy_gbs"] == pytest.approx(1e-9 * 2 * measured["buffer_mib"] * 2**20 / 2)
        assert measured["triad_gbs"] == pytest.approx(1.5 * measured["copy_gbs"])
        assert measured["launch_us"] == measured["queued_launch_us"] == pytest.approx(2e6 / roof.LAUNCHES)
