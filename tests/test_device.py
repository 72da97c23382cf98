"""Device: selection, buffers, programs, and errors that a user can act on."""

import weakref
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

import clsplat.device
import clsplat.programs
from clsplat.device import Device, device_label, list_devices, select_device
from clsplat.errors import DeviceError, InputError
from clsplat.programs import BASE_LANGUAGE, Subgroups, ask, probe_subgroups


def fake(name, kind=cl.device_type.CPU, extensions=""):
    return SimpleNamespace(name=name, platform=SimpleNamespace(name="Fake"), type=kind, extensions=extensions)


class TestSelection:
    @pytest.fixture(autouse=True)
    def no_choice(self, monkeypatch):
        monkeypatch.delenv("PYOPENCL_CTX", raising=False)

    def test_by_part_of_the_label(self, monkeypatch):
        devices = [fake("one"), fake("two")]
        monkeypatch.setattr(clsplat.device, "list_devices", lambda: devices)
        assert select_device("TW") is devices[1]
        assert select_device("fake: one") is devices[0]

    def test_unknown_name(self):
        with pytest.raises(DeviceError, match="--device 'no such device': expected part of one of"):
            select_device("no such device")

    def test_gpu_before_cpu(self, monkeypatch):
        devices = [fake("c"), fake("g", cl.device_type.GPU), fake("a", cl.device_type.ACCELERATOR)]
        monkeypatch.setattr(clsplat.device, "list_devices", lambda: devices)
        assert select_device() is devices[1]
        del devices[1]
        assert select_device().name == "a"

    def test_no_driver(self, monkeypatch):
        def no_platform():
            raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

        monkeypatch.setattr(cl, "get_platforms", no_platform)
        assert list_devices() == []
        with pytest.raises(DeviceError, match=r"no OpenCL device found: .*pip install 'clsplat\[pocl\]'"):
            select_device()

    def test_platform_without_devices(self, monkeypatch, device):
        def no_devices():
            raise cl.RuntimeError("clGetDeviceIDs failed: DEVICE_NOT_FOUND")

        platforms = [SimpleNamespace(get_devices=no_devices), device.cl_device.platform]
        monkeypatch.setattr(cl, "get_platforms", lambda: platforms)
        assert list_devices() == device.cl_device.platform.get_devices()

    def test_pyopencl_ctx(self, monkeypatch, device):
        monkeypatch.setenv("PYOPENCL_CTX", device.cl_device.platform.name.strip())
        assert select_device().platform.name == device.cl_device.platform.name
        monkeypatch.setenv("PYOPENCL_CTX", "no such device")
        with pytest.raises(DeviceError, match="PYOPENCL_CTX='no such device' selects no OpenCL device"):
            select_device()

    def test_no_double_precision(self):
        with pytest.raises(DeviceError, match=r"Fake: half: expected a device with double precision \(cl_khr_fp64\)"):
            Device(fake("half"), real=np.float64)

    def test_label(self, device):
        assert device.label == device_label(device.cl_device)
        assert device.cl_device.name.strip() in device.label and "\n" not in device.label


class TestBuffers:
    def test_upload_converts(self, any_device):
        array = any_device.upload("x", np.arange(6, dtype=np.int64).reshape(2, 3)[:, ::-1])
        assert array.dtype == any_device.real
        np.testing.assert_array_equal(array.get(), [[2, 1, 0], [5, 4, 3]])

    def test_arrays_do_not_keep_those_of_the_host(self, device):
        hosts = [np.arange(6, dtype=device.real)]
        array = device.upload("x", hosts[0])
        array.set(hosts[0] + 1)
        hosts += [array.get(), array.reshape(2, 3).get()]
        alive = [weakref.ref(host) for host in hosts]
        hosts.clear()
        assert not any(host() is not None for host in alive)
        assert array.get()[5] == 6

    def test_upload_of_a_view(self, any_device):
        host = np.arange(6, dtype=any_device.real).reshape(2, 3)
        for view in (host[:, ::-1], host.T, host[:, ::2]):
            np.testing.assert_array_equal(any_device.upload("x", view).get(), view)

    def test_too_large_for_a_buffer(self, device):
        size = device.cl_device.max_mem_alloc_size // 4 + 1
        with pytest.raises(DeviceError, match=r"^splats: needs a buffer of \d+ MiB, but .* allows at most \d+ MiB"):
            device.empty("splats", size)

    @pytest.mark.parametrize("most", [1 << 20, (1 << 20) - 64])
    def test_too_large_with_what_the_pool_adds(self, device, monkeypatch, most):
        monkeypatch.setattr(device.buffers, "_most", most)
        assert device.empty("splats", 15 << 16, np.uint8).nbytes == 15 << 16
        with pytest.raises(DeviceError, match=r"^splats: needs a buffer of 1 MiB, but .* allows at most 1 MiB"):
            device.empty("splats", most, np.uint8)

    def test_memory_is_counted(self):
        device = Device()
        assert device.memory == device.memory_peak == 0
        kept = device.empty("kept", 1 << 18)
        dropped = device.empty("dropped", 1 << 20)
        assert 5 << 20 <= device.memory == device.memory_peak <= 1.1 * (5 << 20)
        del dropped
        peak = device.memory_peak
        device.empty("reused", 1 << 20)
        assert device.memory == device.memory_peak == peak  # what is dropped is kept for reuse
        del kept

    def test_limit(self):
        device = Device(memory_limit=10 << 20)
        kept = device.empty("kept", 1 << 20)
        device.empty("dropped", 1 << 20)
        # Only what is kept for reuse stands in the way: it goes.
        other = device.empty("other", 5 << 18)
        assert device.memory <= device.memory_limit
        with pytest.raises(
            DeviceError, match=r"^more: needs 4 MiB in addition to \d MiB in use, but the limit is 10 MiB"
        ):
            device.empty("more", 1 << 20)
        del kept, other
        device.empty("more", 1 << 20)
        assert device.memory < device.memory_peak <= 10 << 20

    def test_near_the_limit_a_buffer_is_as_small_as_it_can_be(self):
        device = Device(memory_limit=9 << 20)
        device.empty("list", 2 << 20)
        kept = [device.empty("list", 1 << 20) for _ in range(2)]
        assert len(kept) == 2 and device.memory_peak <= 9 << 20

    def test_the_limit_is_at_most_the_memory(self, device):
        memory = device.cl_device.global_mem_size
        assert device.memory_limit == memory
        assert Device(memory_limit=2 * memory).memory_limit == memory

    def test_sizes_that_change_reuse_the_same_memory(self):
        device = Device()
        sizes = np.random.default_rng(0).integers(100_000, 300_000, 200)
        memory = []
        for size in sizes:
            pair = [device.empty("list", int(size), np.uint32) for _ in range(2)]
            np.testing.assert_array_equal(pair[0].fill(3).get(), np.full(size, 3, np.uint32))
            del pair
            memory.append(device.memory)
        # Allocated anew only where a list was longer than all before, by more than the 1/16 of the pool's rounding.
        assert len(set(memory)) < 12
        assert memory[-1] <= 1.07 * 2 * 4 * sizes.max()

    def test_sizes_of_another_order_have_memory_of_their_own(self):
        device = Device()
        large = device.empty("x", 1 << 20)
        before = device.memory
        small = device.empty("x", 1 << 10)
        assert device.memory - before < 5 << 10
        assert (large.size, small.size) == (1 << 20, 1 << 10)

    def test_no_memory_left(self, device, monkeypatch):
        def allocate(size):
            raise cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")

        pool = device.buffers.pool
        sizes = {"managed_bytes": 0, "bin_number": pool.bin_number, "alloc_size": pool.alloc_size}
        full = SimpleNamespace(**sizes, allocate=allocate, free_held=lambda: None)
        monkeypatch.setattr(device.buffers, "pool", full)
        with pytest.raises(DeviceError, match=r"splats: .* has no memory left for 4 MiB; use fewer Gaussians"):
            device.empty("splats", (1024, 1024))

    def test_constants_are_uploaded_when_they_change(self, any_device):
        first = any_device.constant("x", (1, 2, 3))
        assert any_device.constant("x", np.array([1.0, 2.0, 3.0])) is first
        second = any_device.constant("x", (1, 2, 4))
        np.testing.assert_array_equal(second.get(), [1, 2, 4])
        np.testing.assert_array_equal(first.get(), [1, 2, 3])  # who holds it may still use it
        assert any_device.constant("y", (1, 2, 4)) is not second

    def test_scratch_is_zero_and_kept(self, device):
        first = device.scratch("test", 100, "a")
        assert (first.get() == 0).all()
        first.fill(1)
        assert device.scratch("test", 100, "a") is first
        for size, layout in ((100, "b"), (101, "b"), (100, "a")):
            again = device.scratch("test", size, layout)
            assert again.shape == (size,) and (again.get() == 0).all()
            again.fill(1)


class TestLimits:
    def test_a_query_that_the_driver_refuses(self):
        class Refusing:
            local_mem_size = "many"

            @property
            def max_num_sub_groups(self):
                raise cl.LogicError("clGetDeviceInfo failed: INVALID_VALUE")

        assert ask(Refusing(), "max_num_sub_groups", 0) == 0
        assert ask(Refusing(), "no such query", "none") == "none"
        assert ask(Refusing(), "local_mem_size", 0) == 0
        assert probe_subgroups(None, Refusing()) == Subgroups(0, BASE_LANGUAGE)

    @pytest.mark.parametrize(("limit", "expected"), [(1024, 256), (256, 256), (128, 128), (96, 64), (1, 1)])
    def test_groups_are_halved_until_they_fit(self, limit, expected):
        device = Device()
        device.largest_group = limit  # shadows the cached property
        assert device.group(256) == expected

    @pytest.mark.parametrize(
        ("platform", "kind", "expected"), [("Apple", "CPU", 1), ("Apple", "GPU", 256), ("x", "CPU", 256)]
    )
    def test_what_apple_says_of_its_cpu_is_not_believed(self, platform, kind, expected):
        device = Device()
        device.cl_device = SimpleNamespace(
            platform=SimpleNamespace(name=platform),
            type=getattr(cl.device_type, kind),
            max_work_group_size=256,
            max_work_item_sizes=(1024, 1, 1),
        )
        assert device.largest_group == expected

    def test_variants(self, monkeypatch):
        for variants, is_cpu in (("cpu", True), ("gpu", False)):
            monkeypatch.setenv("CLSPLAT_VARIANTS", variants)
            assert Device().is_cpu == is_cpu
        monkeypatch.setenv("CLSPLAT_VARIANTS", "fast")
        with pytest.raises(InputError, match="CLSPLAT_VARIANTS: expected auto, cpu or gpu, found 'fast'"):
            Device().is_cpu  # noqa: B018
