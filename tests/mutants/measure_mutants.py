"""Measure which changes of the mathematics the tests see: one operator, constant or index at a time.

Mutants are drawn at random from the kernels, their launches, the densification, the choice of the size and other
rules of the training, or only from the files that are named. Each is applied to a copy of the project, in which the
tests of that file run until one fails. The results are one JSON object per line; mutants that are in them already are
not repeated. Requires a system that can fork a process.

    $ make mutants COUNT=320
    $ make mutants COUNT=60 ONLY='hashgrid heads'
"""

import argparse
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import NoReturn

from sites import Mutant, drawn

ROOT = Path(__file__).resolve().parents[2]

NOT_MEASURED = ("cl/roof.cl", "clsplat/ops/__init__.py")
"""Files without mathematics of the method: kernels that measure a device, and a list of the stages."""

PROCESSOR_SECONDS = 900
"""Limit of a mutant's processor time: loops may never end. All tests of a file take at most half of it."""

NO_TESTS = 3
"""Exit status of a process in which pytest itself has failed."""

WHOLE = (
    "tests/test_bounds.py",
    "tests/test_gold.py",
    "tests/test_render.py",
    "tests/training/test_loop.py",
    "tests/training/test_resume.py",
)
"""Tests of the whole renderer and of training, for mutants that the tests of their file do not see."""

FIELDS = tuple(f"tests/fields/test_{name}.py" for name in ("layers", "fields", "field_files"))
"""Tests of the training of radiance fields, in the place of those of the renderer."""

FIELD_STAGES = (
    *("encode", "frustums", "hashgrid", "heads", "histograms", "intervals", "march", "mlp", "mlp_cpu", "mlp_gpu"),
    *("mlp_sums", "rays", "spans", "spheres", "voxels", "weights"),
)
"""Stems of files that only radiance fields use."""

PROJECT = ("tests/test_project.py", "tests/test_lens.py", "tests/test_project_degenerate.py")
LIMITS = "tests/test_composite_limits.py"
COMPOSITE = ("tests/test_composite.py", "tests/test_composite_gpu.py", "tests/test_composite_sorted.py", LIMITS)
REMOVAL = ("tests/test_removal.py",)
TESTS: dict[str, tuple[str, ...]] = {
    "common": (*(f"tests/test_{name}.py" for name in ("programs", "observe", "dropout", "composite")), *PROJECT),
    "composite": COMPOSITE,
    "composite_bands": COMPOSITE,
    "composite_blocks": COMPOSITE,
    "composite_cpu": (COMPOSITE[0], LIMITS),
    "composite_gpu": (*COMPOSITE[:2], LIMITS),
    "composite_sorted": COMPOSITE[2:3],
    "composite_splats": COMPOSITE,
    "composite_tiles": (*COMPOSITE[:2], *REMOVAL),
    "ellipse": ("tests/test_bin.py", *COMPOSITE[:1], *PROJECT[:1], "tests/test_dropout.py"),
    "composite_pixels": (*COMPOSITE[:2], "tests/test_median.py"),
    "composite_rays": ("tests/test_gaussian_rays.py",),
    "lanes": PROJECT,
    "lens": PROJECT,
    "linalg": PROJECT,
    "power": (*COMPOSITE[:1], *PROJECT[:1]),
    "project": PROJECT,
    "removal_cpu": REMOVAL,
    "removal_gpu": REMOVAL,
    "removal_residuals": REMOVAL,
    "removal_sums": REMOVAL,
    "sh": PROJECT,
    "spans": ("tests/test_intervals.py", "tests/test_frustums.py"),
    "structs": PROJECT,
    "absgrad": ("tests/test_absgrad.py", "tests/training/test_densify.py"),
    "gaussian_rays": ("tests/test_gaussian_rays.py", "tests/test_median.py"),
    "mlp_cpu": ("tests/test_mlp.py",),
    "mlp_gpu": ("tests/test_mlp.py",),
    "mlp_sums": ("tests/test_mlp.py",),
    "take": ("tests/test_take.py", "tests/training/test_round_transfers.py"),
    "philox": ("tests/test_noise.py", "tests/test_dropout.py"),
}
"""Tests by the stem of the file. Those of other stages are named after it."""

TRAINING = {
    **{
        f"clsplat/training/{name}.py": tuple(f"tests/training/test_{test}.py" for test in (name, "loop"))
        for name in ("camera_room", "coarse_to_fine", "dense_start", "run_length", "sky_start")
    },
    "clsplat/training/few_views.py": ("tests/training/test_few_views_rule.py", "tests/training/test_loop.py"),
    "clsplat/dataset/near_planes.py": ("tests/dataset/test_near_planes.py",),
    "clsplat/dataset/coverage.py": ("tests/dataset/test_coverage.py", "tests/dataset/test_near_planes.py"),
    "clsplat/training/densify": tuple(
        f"tests/training/test_{name}.py" for name in ("densify", "mcmc", "error_guided", "loop")
    ),
    "clsplat/training/autosize": (
        *(f"tests/training/test_autosize{part}.py" for part in ("_rule", "_reduction", "")),
        "tests/commands/test_cli.py",
    ),
}
"""Tests of files and folders of the training."""


def measured_files() -> list[Path]:
    """Files with the mathematics of the method."""
    patterns = ["cl/*.cl", "cl/*.h", "clsplat/ops/*.py"]
    patterns += [name if name.endswith(".py") else f"{name}/*.py" for name in TRAINING]
    found = [path for pattern in patterns for path in sorted(ROOT.glob(pattern))]
    return [path for path in found if path.relative_to(ROOT).as_posix() not in NOT_MEASURED]


def tests_of(path: str) -> tuple[str, ...]:
    """Tests that should see a change of a file, the quickest first."""
    for folder, tests in TRAINING.items():
        if path.startswith(folder):
            return tests
    stem = Path(path).stem
    whole = FIELDS if stem in FIELD_STAGES else WHOLE
    return tuple(dict.fromkeys((*TESTS.get(stem, (f"tests/test_{stem}.py",)), *whole)))


def run_tests(copy: Path, tests: tuple[str, ...], seconds: int) -> tuple[bool, str]:
    """Whether tests pass in a copy of the project, and the first one that does not or how their process ended.

    They run for at most `seconds` of processor time, in a fork of this process, which has imported the libraries, but
    nothing of clsplat.
    """
    report = copy / "first-failure"
    report.unlink(missing_ok=True)
    child = os.fork()
    if not child:
        try:
            _run_here(copy, tests, seconds, report)
        finally:
            os._exit(NO_TESTS)
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        return False, signal.Signals(os.WTERMSIG(status)).name
    return os.WEXITSTATUS(status) == 0, report.read_text() if report.exists() else f"exit {os.WEXITSTATUS(status)}"


def _run_here(copy: Path, tests: tuple[str, ...], seconds: int, report: Path) -> NoReturn:
    os.chdir(copy)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    sys.path.insert(0, str(copy))
    import pytest

    class First:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                path.write_text(report.nodeid)

    path, options = report, ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(copy)]
    os._exit(int(pytest.main([*options, *tests], plugins=[First()])))


def measure(mutant: Mutant, copy: Path) -> dict[str, object]:
    """Run the tests on a mutant; the copy is left as it was."""
    path = copy / mutant.path
    text = path.read_text(encoding="utf-8")
    started = time.perf_counter()
    path.write_text(mutant.applied(text), encoding="utf-8")
    try:
        passed, by = run_tests(copy, tests_of(mutant.path), PROCESSOR_SECONDS)
    finally:
        path.write_text(text, encoding="utf-8")
    context = text.splitlines()[mutant.line - 1].strip()
    seconds = round(time.perf_counter() - started, 1)
    return asdict(mutant) | {"code": context, "killed": not passed, "by": None if passed else by, "seconds": seconds}


def key(mutant: Mutant, text: str) -> tuple[str, str, str, str, int]:
    """Identity of a mutant in results, which lines moved elsewhere in the file do not change."""
    code = text.splitlines()[mutant.line - 1].strip()
    column = mutant.start - text.rfind("\n", 0, mutant.start)
    return mutant.path, code, mutant.before, mutant.after, column


def main() -> None:
    """Measure the mutants that are not in the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=320, help="number of mutants that are drawn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="names of files without their suffix: all of them by default")
    parser.add_argument("-o", "--out", type=Path, required=True, help="results, JSON lines")
    arguments = parser.parse_args()
    import numpy  # noqa: F401
    import pyopencl  # noqa: F401
    import pytest  # noqa: F401
    import scipy.spatial  # noqa: F401

    done = set()
    if arguments.out.exists():
        done = {tuple(json.loads(line)["key"]) for line in arguments.out.read_text().splitlines()}
    with tempfile.TemporaryDirectory() as folder, arguments.out.open("a") as out:
        copy = Path(folder) / "project"
        ignore = shutil.ignore_patterns(".git", "docs", "notebooks", "build", "__pycache__", "*.egg-info")
        shutil.copytree(ROOT, copy, ignore=ignore)
        os.environ |= {"POCL_CACHE_DIR": str(Path(folder) / "kernels"), "PYTHONDONTWRITEBYTECODE": "1"}
        files = [path for path in measured_files() if not arguments.only or path.stem in arguments.only]
        chosen = drawn(files, ROOT, arguments.count, arguments.seed)
        tests = tuple(dict.fromkeys(test for mutant in chosen for test in tests_of(mutant.path)))
        passed, by = run_tests(copy, tests, resource.RLIM_INFINITY)
        if not passed:
            sys.exit(f"tests: expected to pass without a mutant, failed: {by}")
        for number, mutant in enumerate(chosen, 1):
            identity = key(mutant, (ROOT / mutant.path).read_text(encoding="utf-8"))
            if identity in done:
                continue
            result = measure(mutant, copy) | {"key": identity}
            out.write(json.dumps(result) + "\n")
            out.flush()
            verdict = "killed" if result["killed"] else "SURVIVED"
            print(
                f"[{number}/{len(chosen)}] {mutant.path}:{mutant.line} {mutant.before} -> {mutant.after}: {verdict}"
            )


if __name__ == "__main__":
    main()
