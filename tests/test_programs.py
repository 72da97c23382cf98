"""Programs: sources, builds, and the languages of subgroups."""

import warnings
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

import clsplat.device
import clsplat.programs
from clsplat.device import Device
from clsplat.errors import BuildError, DeviceError
from clsplat.programs import (
    BASE_LANGUAGE,
    POCL,
    Subgroups,
    build,
    build_options,
    check_space,
    inline_includes,
    kernel_folder,
    probe_subgroups,
)


class TestPrograms:
    def test_arguments(self, any_device, kernels):
        (kernels / "echo.cl").write_text(
            '#include "common.h"\n'
            "__kernel void echo(int i, uint u, real r, const __global real *x, __global real *out) {\n"
            "    out[0] = i; out[1] = u; out[2] = r; out[3] = x[1]; out[4] = SCALE * r;\n}\n"
        )
        x, out = any_device.upload("x", [3, 4]), any_device.empty("out", 5)
        any_device.launch("echo", "echo", (1,), [-7, 2**31, 0.1, x, out], defines={"SCALE": 0.5})
        expected = np.array([-7, 2**31, 0.1, 4, 0.5 * any_device.real.type(0.1)])
        np.testing.assert_array_equal(out.get(), expected.astype(any_device.real))

    def test_integers_have_32_bits(self, device, kernels):
        (kernels / "two.cl").write_text("__kernel void two(int i, int j, __global int *x) { x[0] = i; x[1] = j; }\n")
        out = device.empty("out", 2, np.int32)
        for i, j in ((np.int64(-7), 8), (-7, np.int8(8)), (np.int32(-7), np.uint64(8))):
            device.launch("two", "two", (1,), [i, j, out.fill(0)])
            assert out.get().tolist() == [-7, 8]

    def test_integers_of_more_bits_are_refused(self, device, kernels):
        (kernels / "large.cl").write_text("__kernel void large(int i, __global int *x) { x[0] = i; }\n")
        out = device.empty("out", 1, np.int32)
        for largest in (2**32 - 1, -(2**31)):
            device.launch("large", "large", (1,), [largest, out])
            assert out.get()[0] == np.uint32(largest % 2**32).astype(np.int32)
        for larger in (2**32, np.int64(2**40), -(2**31) - 1):
            with pytest.raises(DeviceError, match=f"^large: expected integers of 32 bits, found {larger}; use fewer"):
                device.launch("large", "large", (1,), [larger, out])

    def test_arguments_that_do_not_fit_leave_nothing_behind(self, device, kernels):
        (kernels / "one.cl").write_text("__kernel void one(int i, __global int *x) { x[0] = i; }\n")
        out = device.empty("out", 1, np.int32)
        with pytest.raises(cl.Error):
            device.launch("one", "one", (1,), [np.zeros(1, [("a", "i4"), ("b", "i4")])[0], out])
        device.launch("one", "one", (1,), [5, out])
        assert out.get()[0] == 5

    def test_built_once_for_each_set_of_defines(self, device, kernels, monkeypatch):
        (kernels / "fill.cl").write_text(
            "__kernel void one(__global float *x) { x[0] = VALUE; }\n"
            "__kernel void two(__global float *x) { x[0] = 2 * VALUE; }\n"
        )
        builds = []
        program = Device.program
        monkeypatch.setattr(Device, "program", lambda *a: builds.append(a) or program(*a))
        out = device.empty("out", 1)
        for kernel, value, expected in [("one", 3, 3), ("two", 3, 6), ("one", 4, 4), ("one", 3, 3)]:
            device.launch("fill", kernel, (1,), [out], defines={"VALUE": value})
            assert out.get()[0] == expected
        assert len(builds) == 2

    def test_errors_name_file_and_line(self, device, kernels):
        (kernels / "broken.h").write_text("\n\n\nint broken( {\n")
        (kernels / "broken.cl").write_text('#include "broken.h"\n__kernel void k() {}\n')
        # NVIDIA's compiler ignores #line, and counts the lines of the whole source.
        with pytest.raises(cl.RuntimeError, match=r"cl/broken\.h:4|<kernel>:6"):
            device.program("broken", {})
        (kernels / "broken.cl").write_text('#include "common.h"\n#include "linalg.h"\n\n__kernel void k() { x; }\n')
        with pytest.raises(cl.RuntimeError, match=r"cl/broken\.cl:4|<kernel>:\d+"):
            device.program("broken", {})

    @pytest.mark.parametrize("shown", [True, False])
    def test_what_the_compiler_says_is_shown_on_demand(self, device, kernels, monkeypatch, recwarn, shown):
        """By ``-v``, which sets pyopencl's variable. PoCL has nothing to say of a kernel that is right."""
        (kernels / "quiet.cl").write_text("__kernel void k() { }\n")
        monkeypatch.delenv("PYOPENCL_COMPILER_OUTPUT", raising=False)
        if shown:
            monkeypatch.setenv("PYOPENCL_COMPILER_OUTPUT", "1")

        class Talkative:
            def __init__(self, *_):
                pass

            def build(self, _):
                warnings.warn("vectorised", cl.CompilerWarning, stacklevel=1)

        monkeypatch.setattr(cl, "Program", Talkative)
        device.program("quiet", {"SHOWN": int(shown)})
        assert [str(w.message) for w in recwarn] == ["vectorised"] * shown

    def test_includes_are_inlined(self, kernels):
        (kernels / "inner.h").write_text("inner\n")
        (kernels / "outer.h").write_text('before\n  #include "inner.h"\nafter\n')
        (kernels / "main.cl").write_text('#include "outer.h"\nlast\n')
        assert inline_includes("main.cl", kernels).splitlines() == [
            '#line 1 "cl/main.cl"',
            '#line 1 "cl/outer.h"',
            "before",
            '#line 1 "cl/inner.h"',
            "inner",
            '#line 3 "cl/outer.h"',
            "after",
            '#line 2 "cl/main.cl"',
            "last",
        ]

    def test_sources_are_missing(self, tmp_path, monkeypatch):
        monkeypatch.setattr(clsplat.programs, "__file__", str(tmp_path / "clsplat" / "programs.py"))
        with pytest.raises(DeviceError, match=r"cl/common\.h: expected the kernel sources in .*; reinstall clsplat"):
            kernel_folder()

    def test_constants_reach_the_kernels(self, any_device, kernels):
        names = clsplat.device.MODEL_CONSTANTS
        body = " ".join(f"out[{i}] = {name};" for i, name in enumerate(names))
        (kernels / "constants.cl").write_text(
            f'#include "common.h"\n__kernel void read(__global real *out) {{ {body} }}\n'
        )
        out = any_device.empty("out", len(names))
        any_device.launch("constants", "read", (1,), [out])
        expected = [getattr(clsplat.constants, name) for name in names]
        np.testing.assert_array_equal(out.get(), np.array(expected, any_device.real))

    @pytest.mark.parametrize("name", clsplat.device.MODEL_CONSTANTS)
    def test_each_constant_is_required(self, device, name):
        """Otherwise a driver might take one for 0, in an #if."""
        source = inline_includes("common.h", kernel_folder()) + "\n__kernel void nothing(void) {}\n"
        whole = build_options(np.float32, device.model)
        build(device.context, source, whole)
        with pytest.raises(cl.RuntimeError, match="must be passed as -D"):
            build(device.context, source, [option for option in whole if not option.startswith(f"-D{name}=")])

    def test_values_of_numpy(self):
        assert "-DBLUR=0.1" in build_options(np.float32, {"BLUR": np.float64(0.1)})

    def test_a_build_that_fails_with_subgroups_is_repeated_without(self, monkeypatch):
        """OpenCL C 1.2 does not declare their functions. The warning comes once, and the device runs without them."""
        device = Device()
        device.subgroup_size, device._subgroups = 16, Subgroups(16, BASE_LANGUAGE)
        defines = {
            "TILE": 8,
            "CHANNELS": 3,
            "ITEMS": 64,
            "STAGED": 16,
            "BATCH": 16,
            "SEGMENT": 64,
            "RAYS": 0,
            "SUBGROUPS": 1,
        }
        with pytest.warns(UserWarning, match=r"cl/composite_gpu\.cl is built without subgroups: "):
            program = device.program("composite_gpu", defines)
        assert program.all_kernels() and device.subgroup_size == 0

    def test_an_error_in_a_source_is_not_one_of_subgroups(self, kernels, recwarn):
        (kernels / "broken.cl").write_text("#error on purpose\n")
        with pytest.raises(cl.RuntimeError, match="on purpose"):
            Device().program("broken", {"SUBGROUPS": 1})
        assert not [w for w in recwarn if w.category is UserWarning]


class TestSubgroups:
    def probe(self, monkeypatch, languages, version="OpenCL 3.0 x", count=8, extensions="cl_khr_subgroups"):
        """What is found of a device whose compiler has the functions in some languages; and what was tried."""
        tried = []

        def build(context, source, options):
            tried.append(options[0])
            if options[0] not in languages:
                raise cl.RuntimeError("clBuildProgram failed: BUILD_PROGRAM_FAILURE")
            kernel = SimpleNamespace(get_sub_group_info=lambda device, question, group: 32)
            return SimpleNamespace(all_kernels=lambda: [kernel])

        monkeypatch.setattr(clsplat.programs, "build", build)
        found = SimpleNamespace(
            version=version, max_num_sub_groups=count, extensions=extensions, max_work_group_size=256
        )
        return probe_subgroups(None, found), tried

    def test_the_newest_language_that_builds_is_taken(self, monkeypatch):
        both = ["-cl-std=CL3.0", "-cl-std=CL2.0"]
        assert self.probe(monkeypatch, both) == (Subgroups(32, both[0]), both[:1])
        assert self.probe(monkeypatch, both[1:]) == (Subgroups(32, both[1]), both)
        assert self.probe(monkeypatch, both, version="OpenCL 2.0 x") == (Subgroups(32, both[1]), both[1:])

    def test_a_compiler_without_their_functions_has_none(self, monkeypatch):
        """Whatever the driver says of itself: rusticl and ROCm name the extension, and do not declare it in 1.2."""
        assert self.probe(monkeypatch, [])[0].size == 0
        assert self.probe(monkeypatch, [BASE_LANGUAGE], version="OpenCL 1.2 x") == (Subgroups(0, BASE_LANGUAGE), [])
        assert self.probe(monkeypatch, ["-cl-std=CL3.0"], count=0, extensions="") == (
            Subgroups(0, BASE_LANGUAGE),
            [],
        )


def test_a_full_disk_is_named_before_pocl_ends_the_process(tmp_path, monkeypatch):
    """PoCL aborts where it cannot write a kernel that it has compiled."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "absent" / "cache"))
    pocl, other = (SimpleNamespace(platform=SimpleNamespace(name=name)) for name in (POCL, "Other"))
    check_space(pocl)
    asked = []
    monkeypatch.setattr("shutil.disk_usage", lambda path: asked.append(path) or SimpleNamespace(free=4095))
    check_space(other)
    with pytest.raises(BuildError, match=r"cannot build the kernels: .*cache, whose disk has 4095 bytes left"):
        check_space(pocl)
    assert asked == [tmp_path]
