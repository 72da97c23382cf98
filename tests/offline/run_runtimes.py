"""Run the tests of the stages on every OpenCL implementation of this machine, one after the other.

Run by `make check-runtimes`. An implementation is a driver that is listed in /etc/OpenCL/vendors, or Intel's runtime
for CPUs from PyPI (intel-opencl-rt and intel-cmplr-lib-rt), which comes without a usable entry in that list.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

VENDORS = Path("/etc/OpenCL/vendors")

# Intel's runtime in a virtual environment; the entry that comes with it names a library of another folder.
INTEL = Path(sys.prefix) / "lib" / "libintelocl.so"

TESTS = Path(__file__).resolve().parents[1]

LABEL = "from clsplat.device import Device; print(Device().label)"


def drivers(extra: list[Path]) -> list[Path]:
    """Libraries of the drivers: the listed ones, Intel's, and those that the user names."""
    listed = [Path(path.read_text().strip()) for path in sorted(VENDORS.glob("*.icd"))]
    return [*listed, *([INTEL] if INTEL.is_file() else []), *extra]


def stage_tests() -> list[str]:
    """The tests of stages, and the self-test."""
    stages = sorted(path.stem for path in (TESTS.parent / "clsplat" / "ops").glob("*.py") if path.stem != "__init__")
    found = [path for stage in stages for path in sorted(TESTS.glob(f"test_{stage}*.py"))]
    return [*map(str, found), str(TESTS / "test_selftest.py")]


def run(driver: Path, tests: list[str]) -> bool:
    """Run the tests on one driver, with its name before and the last line of pytest after."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "driver.icd").write_text(f"{driver}\n")
        # rusticl shows no device unless it is asked for.
        env = os.environ | {"OCL_ICD_VENDORS": folder, "PYOPENCL_CTX": "0", "RUSTICL_ENABLE": "llvmpipe"}
        opened = subprocess.run([sys.executable, "-c", LABEL], env=env, capture_output=True, text=True)
        print(f"{driver}: {opened.stdout.strip() or 'no device'}", flush=True)
        if opened.returncode:
            return False
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
        lines = subprocess.run(command, env=env, capture_output=True, text=True).stdout.splitlines()
    for line in lines:
        if re.match(r"(FAILED|ERROR) |.*\d (passed|failed|errors?)\b", line):
            print(f"  {line}", flush=True)
    return bool(lines) and "passed" in lines[-1] and "failed" not in lines[-1] and "error" not in lines[-1]


def main() -> None:
    """Run, and end with status 1 if a test fails on a driver, or a driver has no device."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--driver", type=Path, action="append", default=[], help="library of another driver")
    parser.add_argument("tests", nargs="*", help="tests to run; default: those of all stages")
    arguments = parser.parse_args()
    found = drivers(arguments.driver)
    if not found:
        sys.exit(
            f"expected drivers in {VENDORS} or Intel's runtime beside Python, found none; name one with --driver"
        )
    results = [run(driver, arguments.tests or stage_tests()) for driver in found]
    sys.exit(0 if all(results) else 1)


if __name__ == "__main__":
    main()
