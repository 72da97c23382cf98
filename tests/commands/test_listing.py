"""The command `devices`."""

import re
from types import SimpleNamespace

import pytest
from cli_runs import run

import clsplat.device
import clsplat.selftest
from clsplat.commands.listing import describe


def test_devices_names_the_default_and_tests_each(capsys: pytest.CaptureFixture[str]) -> None:
    run("devices")
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("* ") for line in lines) == 2  # the device and the line that explains the star
    assert (
        sum(re.fullmatch(r"    works: all \d+ stages agree with the reference", line) is not None for line in lines)
        > 0
    )


def test_devices_stars_one_of_two_equal_entries_and_checks(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two files of one driver in the list of drivers are two entries that compare equal."""
    twice = clsplat.device.list_devices()[:1] * 2
    monkeypatch.setattr(clsplat.device, "list_devices", lambda: twice)
    monkeypatch.setattr(clsplat.selftest, "faults_of", lambda index: {"scan": "found 7"} if index else {})
    with pytest.raises(SystemExit) as ended:
        run("devices", "--check")
    out = capsys.readouterr().out
    assert ended.value.code == 1
    assert len(re.findall(r"^\* .*: ", out, re.M)) == 1
    assert out.count("works: all") == 1 and out.count("FAILS: scan: found 7") == 1
    run("devices")  # without --check, faults are only reported
    monkeypatch.setattr(clsplat.selftest, "faults_of", lambda index: {})
    run("devices", "--check")


def test_devices_shows_known_faults_and_what_a_driver_refuses(capsys: pytest.CaptureFixture[str]) -> None:
    platform = SimpleNamespace(name="rusticl")
    describe(
        SimpleNamespace(name="llvmpipe", platform=platform, version="OpenCL 3.0", driver_version="25.0.7"), False
    )
    out = capsys.readouterr().out
    assert "  rusticl: llvmpipe" in out and "0 compute units" in out
    assert "known: declares subgroups in OpenCL C 3.0 alone" in out


@pytest.mark.parametrize(
    ("library", "platform", "said"),
    [
        ("libnvidia-opencl.so.1", "Portable Computing Language", True),
        ("libnvidia-opencl.so.1", "NVIDIA CUDA", False),
        (None, "Portable Computing Language", False),
    ],
)
def test_devices_says_that_a_driver_is_installed_and_not_listed(
    library: str | None,
    platform: str,
    said: bool,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("clsplat.commands.listing.find_library", {"nvidia-opencl": library}.get)
    only = SimpleNamespace(name="a device", platform=SimpleNamespace(name=platform))
    monkeypatch.setattr(clsplat.device, "list_devices", lambda: [only])
    monkeypatch.setattr(clsplat.device, "select_device", lambda: only)
    monkeypatch.setattr(clsplat.selftest, "faults_of", lambda index: {})
    run("devices")
    out = capsys.readouterr().out
    assert ("NVIDIA's driver is installed" in out) == said and ("(libnvidia-opencl.so.1)" in out) == said
