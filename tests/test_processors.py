"""Processors that PoCL's compiler does not know: the name that it gets instead."""

import ctypes
import sys
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

from clsplat.errors import BuildError, driver_errors
from clsplat.processors import AVX512, DESCRIPTION_WORDS, LEVELS, level_of, name_processor, vector_width

VERSION = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic"
FEATURES = {level: set(" ".join([*LEVELS.values()][i:]).split()) for i, level in enumerate(LEVELS)}

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="PoCL's description is replaced on Linux only")


class Description:
    """A description of a device as PoCL has it: two pointers to texts, one after the other, among other words."""

    def __init__(self, name, target=b"x86_64-unknown-linux-gnu"):
        self.words = (ctypes.c_uint64 * DESCRIPTION_WORDS)(*range(0, 2**63, 2**63 // DESCRIPTION_WORDS + 1))
        self.texts = [ctypes.create_string_buffer(text) for text in (target, name)]
        self.words[78:80] = [ctypes.addressof(text) for text in self.texts]
        self.device = SimpleNamespace(int_ptr=ctypes.addressof(self.words), version=VERSION)

    def name(self):
        return ctypes.string_at(self.words[79])


@pytest.fixture
def processor(monkeypatch):
    """A function that sets the features of the processor."""

    def set_features(features):
        text = f"processor\t: 0\nvendor_id\t: AuthenticAMD\nflags\t\t: {' '.join(sorted(features))}\nbugs\t\t: none\n"
        monkeypatch.setattr(Path, "read_text", lambda self: text if str(self) == "/proc/cpuinfo" else None)

    return set_features


def test_levels_need_all_features_of_those_below():
    assert [level_of(features | {"fpu"}) for features in FEATURES.values()] == [*LEVELS]
    assert level_of(FEATURES[AVX512] - {"avx512dq"}) == "x86-64-v3"
    assert level_of(FEATURES[AVX512] - {"ssse3"}) == "x86-64"


@on_linux
@pytest.mark.parametrize(
    ("name", "level", "named"),
    [
        (b"generic", AVX512, AVX512),
        (b"generic", "x86-64-v2", "x86-64-v2"),
        (b"znver3", AVX512, AVX512),
        (b"znver3", "x86-64-v3", None),
        (b"skylake-avx512", AVX512, None),
    ],
)
def test_wrong_names_are_replaced(processor, name, level, named):
    processor(FEATURES[level])
    description = Description(name)
    before = [*description.words]
    assert name_processor(description.device) == named
    assert description.name() == (named.encode() if named else name)
    assert [i for i in range(DESCRIPTION_WORDS) if description.words[i] != before[i]] == ([79] if named else [])
    assert name_processor(description.device) == named  # another Device of the process


@on_linux
@pytest.mark.parametrize("target", [b"aarch64-linux-gnu", b""])
def test_other_descriptions_are_left_as_they_are(processor, target):
    processor(FEATURES[AVX512])
    description = Description(b"generic", target)
    assert name_processor(description.device) is None
    assert description.name() == b"generic"


@on_linux
def test_other_drivers_and_unreadable_addresses_are_left_alone(processor):
    processor(FEATURES[AVX512])
    description = Description(b"generic")
    description.device.version = "OpenCL 3.0 LINUX"
    assert name_processor(description.device) is None
    assert description.name() == b"generic"
    assert name_processor(SimpleNamespace(int_ptr=0, version=VERSION)) is None


@on_linux
def test_a_system_that_names_no_features(monkeypatch):
    monkeypatch.setattr(Path, "read_text", lambda self: "processor : 0\n")
    assert name_processor(Description(b"generic").device) is None


def test_vectors_are_those_of_the_compiler():
    device = SimpleNamespace(native_vector_width_float=16, version=VERSION)
    assert [vector_width(device, level) for level in (AVX512, "x86-64-v3", None)] == [16, 8, 16]
    device.version = VERSION.replace("generic", "znver3")
    assert vector_width(device, None) == 8
    assert vector_width(SimpleNamespace(), None) == 8


def test_a_processor_that_stays_unknown_is_one_sentence(device):
    with pytest.raises(cl.RuntimeError) as failed:
        cl.Program(device.context, "#error unknown target CPU 'generic'").build()
    with pytest.raises(BuildError, match=r"newer than the OpenCL driver, .* install a newer driver"), driver_errors():
        raise failed.value
