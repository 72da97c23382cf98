"""The model of the time of a step: known coefficients are found, and the recorded measurements predict each other."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.bench.time_model import (
    HARDWARE,
    OTHERS,
    TERMS,
    Limits,
    checked,
    fitted,
    limits_of,
    model_of,
    predicted,
    terms,
)
from clsplat.bench.time_report import COLUMNS, model_text
from clsplat.errors import InputError

ROOF = {
    "launch_us": 10.0,
    "copy_gbs": 20.0,
    "triad_gbs": 25.0,
    "fma_gflops": 100.0,
    "exp_gops": 2.0,
    "exp2_gops": 4.0,
}
LIMITS = Limits(1e-5, 25e9, 100e9, 4e9)
STAGES = ("project_fwd", "bin_splats", "composite_fwd", "l1_ssim", "composite_bwd", "observe", "project_bwd_adam")
FACTORS = {stage: np.linspace(1.5, 3.0, len(TERMS.get(stage, OTHERS))) for stage in STAGES}
RECORDED = Path(__file__).parents[2] / "docs" / "results"


def results(noise: float = 0.0) -> dict[str, Any]:
    """Results of workloads whose times the model describes, up to the relative noise."""
    rng, workloads = np.random.default_rng(0), []
    for n in (1000, 10_000, 100_000, 1_000_000):
        for width in (160, 640):
            workload: dict[str, Any] = {"name": f"{n}-{width}", "gaussians": n, "width": width, "height": width}
            workload["counts"] = {"pairs_evaluated": 40 * width**2 + n, "intersections": 3 * n + width**2 // 50}
            workload["stages"] = {s: {"kernels": {"k": {"launches": 3}}, "bytes": 200 * n} for s in STAGES}
            for stage, measured in workload["stages"].items():
                time = terms(stage, workload, LIMITS) @ FACTORS[stage]
                measured["median_ms"] = 1e3 * time * (1 + noise * rng.uniform(-1, 1))
            workload["step"] = {"median_ms": sum(s["median_ms"] for s in workload["stages"].values())}
            workloads.append(workload)
    return {"device": {"kind": "gpu"}, "roof": ROOF, "workloads": workloads}


def test_limits_are_those_measured() -> None:
    assert limits_of(ROOF) == pytest.approx(LIMITS)


@pytest.mark.parametrize("stage", STAGES)
def test_known_coefficients_are_found(stage: str) -> None:
    workloads = results()["workloads"]
    np.testing.assert_allclose(fitted(stage, workloads, LIMITS), FACTORS[stage], rtol=1e-6)
    # With other coefficients the times are others.
    assert predicted({stage: 2 * FACTORS[stage]}, workloads[0], LIMITS)[stage] == pytest.approx(
        2e-3 * workloads[0]["stages"][stage]["median_ms"]
    )


def test_errors_are_those_of_workloads_left_out() -> None:
    exact, noisy = checked(results()), checked(results(0.2))
    assert set(exact) == {*STAGES, "step"}
    for stage, errors in exact.items():
        np.testing.assert_allclose(errors, 0, atol=1e-6)
        assert errors.shape == (8,) and 0.01 < np.abs(noisy[stage]).max() < 1
    # A workload that is wrong is predicted as if it were right, since its own time is not fitted.
    wrong = results()
    wrong["workloads"][5]["stages"]["observe"]["median_ms"] *= 2
    assert checked(wrong)["observe"][5] == pytest.approx(-0.5, abs=1e-6)


def test_a_device_twice_as_fast_takes_half_the_time() -> None:
    model, workload = model_of(results()), results()["workloads"][-1]
    twice = Limits(LIMITS.launch / 2, 2 * LIMITS.bytes, 2 * LIMITS.flops, 2 * LIMITS.exps)
    slow, fast = (predicted(model, workload, limits) for limits in (LIMITS, twice))
    assert fast == pytest.approx({stage: time / 2 for stage, time in slow.items()})


def test_few_workloads() -> None:
    few = results() | {"workloads": results()["workloads"][:5]}
    with pytest.raises(InputError, match="workloads: expected at least 6 for a model of the time, found 5"):
        model_of(few)


@pytest.mark.parametrize("name", ["kernels", "kernels-intel", "kernels-h200"])
def test_the_recorded_measurements_predict_each_other(name: str) -> None:
    """Within 25 % in the median, for each stage and for whole steps."""
    for stage, errors in checked(json.loads((RECORDED / f"{name}.json").read_text())).items():
        assert np.median(np.abs(errors)) < 0.25, stage


def test_the_text_has_all_stages_and_devices() -> None:
    text = model_text(results())
    lines = text.splitlines()
    assert all(name in lines[0] for name in COLUMNS)
    for name in (*(f"`{stage}`" for stage in STAGES), "whole step", *(hardware.name for hardware in HARDWARE)):
        assert any(line.startswith(f"| {name}") for line in lines), name
    assert "device, step of 1000000-640" in text
    assert all(f"* {hardware.name}: {hardware.source}." in lines for hardware in HARDWARE)


def test_a_cpu_predicts_no_gpu() -> None:
    text = model_text(results() | {"device": {"kind": "cpu"}})
    assert model_text(results()).startswith(text)
    assert "whole step" in text and HARDWARE[0].name not in text
