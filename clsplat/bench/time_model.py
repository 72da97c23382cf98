"""A model of the time of a training step: counts of a scene over measured limits of a device, stage by stage.

The time of a stage is a sum of terms. Each term is an amount of work, over the limit of the device for such work,
times a coefficient. The coefficients are fitted to measurements of `clsplat bench kernels`; with all limits reached,
those of launches, bytes and exponentials would be 1. With the limits of another device, the model predicts its times.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from clsplat.errors import InputError

Record = dict[str, Any]
Array = NDArray[np.float64]

LEAST_WORKLOADS = 6
"""Fewest workloads for a fit: twice as many as the terms of a stage."""


TERMS = {
    "bin_splats": ("launches", "bytes", "operations"),
    "l1_ssim": ("launches", "operations"),
    "composite_fwd": ("launches", "exps", "operations"),
    "composite_bwd": ("launches", "exps", "operations"),
}
"""Terms of the stages; the others have those of `OTHERS`."""

OTHERS = ("launches", "bytes")


class Limits(NamedTuple):
    """Limits of a device: seconds per launch, bytes, multiplications or additions, and exponentials per second."""

    launch: float
    bytes: float
    flops: float
    exps: float


@dataclass(frozen=True)
class Hardware:
    """A device that was not measured: its name, its limits as published, and where they come from."""

    name: str
    limits: Limits
    source: str


LAUNCH_DISCRETE, LAUNCH_MOBILE = 1.5e-5, 2e-5
"""Assumed seconds per launch of a discrete GPU and of one in a mobile chip, with the wait for its end. No vendor
publishes them. The first is about that of an NVIDIA H200 (docs/gpu.md)."""

HARDWARE = (
    Hardware(
        "AMD RX 7900 XTX",
        Limits(LAUNCH_DISCRETE, 0.96e12, 61.4e12, 96 * 16 * 2.5e9),
        "product page: 960 GB/s, 61.4 TFLOPS, 96 compute units, 2.5 GHz; transcendentals at a quarter of the rate",
    ),
    Hardware(
        "Intel Arc B580",
        Limits(LAUNCH_DISCRETE, 0.456e12, 13.7e12, 20 * 32 * 2.67e9),
        "product page: 456 GB/s, 20 Xe cores of 128 lanes, 2.67 GHz; transcendentals at a quarter of the rate",
    ),
    Hardware(
        "Apple M3, 10 cores",
        Limits(LAUNCH_MOBILE, 0.1e12, 3.5e12, 10 * 32 * 1.4e9),
        "product page: 100 GB/s, 10 cores of 128 lanes; 1.4 GHz and a quarter of the rate are assumed",
    ),
    Hardware(
        "Qualcomm Adreno 750",
        Limits(LAUNCH_MOBILE, 0.077e12, 2.8e12, 0.35e12),
        "Snapdragon 8 Gen 3: LPDDR5X at 77 GB/s; the two rates are estimates of others",
    ),
)
"""Devices whose times are predicted. They were not measured, and no kernel ran on them."""


def limits_of(roof: Record) -> Limits:
    """The limits that `clsplat bench kernels` measured."""
    return Limits(
        roof["launch_us"] * 1e-6,
        max(roof["copy_gbs"], roof["triad_gbs"]) * 1e9,
        roof["fma_gflops"] * 1e9,
        max(roof["exp_gops"], roof["exp2_gops"]) * 1e9,
    )


def terms(stage: str, workload: Record, limits: Limits) -> Array:
    """Seconds of the terms of a stage, in the order of `TERMS`, before the coefficients.

    Compositing evaluates an exponential for each pair of splat and pixel. It also tests, for each intersection of
    splat and tile, which pixels the splat may cover. The model counts one operation for each intersection, and for
    each pixel of the loss, so that the coefficient is the number of operations.
    """
    measured, counts = workload["stages"][stage], workload["counts"]
    items = workload["width"] * workload["height"] if stage == "l1_ssim" else counts["intersections"]
    amounts = {
        "launches": sum(kernel["launches"] for kernel in measured["kernels"].values()) * limits.launch,
        "bytes": measured.get("bytes", 0) / limits.bytes,
        "exps": counts["pairs_evaluated"] / limits.exps,
        "operations": items / limits.flops,
    }
    return np.array([amounts[name] for name in TERMS.get(stage, OTHERS)])


def fitted(stage: str, workloads: Sequence[Record], limits: Limits) -> Array:
    """Coefficients of a stage, none of them negative, with the smallest squared relative errors."""
    times = np.array([seconds(workload["stages"][stage]) for workload in workloads])
    rows = np.array([terms(stage, workload, limits) for workload in workloads])
    return nnls(rows / times[:, None], np.ones(len(times)))[0]


def seconds(summary: Record) -> float:
    """Median wall time of a stage or step."""
    return float(summary["median_ms"]) / 1e3


def model_of(results: Record) -> dict[str, Array]:
    """Coefficients of all stages.

    Parameters
    ----------
    results : dict
        Of `clsplat.bench.kernels.bench_kernels`.

    Raises
    ------
    InputError
        If there are fewer than `LEAST_WORKLOADS` workloads.
    """
    workloads = results["workloads"]
    if len(workloads) < LEAST_WORKLOADS:
        raise InputError(
            f"workloads: expected at least {LEAST_WORKLOADS} for a model of the time, found {len(workloads)}"
        )
    limits = limits_of(results["roof"])
    return {stage: fitted(stage, workloads, limits) for stage in workloads[0]["stages"]}


def predicted(model: dict[str, Array], workload: Record, limits: Limits) -> dict[str, float]:
    """Predicted seconds of the stages of a workload on a device with such limits."""
    return {stage: float(terms(stage, workload, limits) @ factors) for stage, factors in model.items()}


def checked(results: Record) -> dict[str, Array]:
    """Relative errors of predictions: of each stage, and of their sum against the whole step ("step").

    Each workload is predicted by a model that is fitted to the others.

    Parameters
    ----------
    results : dict
        Of `clsplat.bench.kernels.bench_kernels`, with at least one workload more than a model needs.
    """
    workloads, limits = results["workloads"], limits_of(results["roof"])
    found = []
    for left_out, workload in enumerate(workloads):
        others = [*workloads[:left_out], *workloads[left_out + 1 :]]
        times = predicted(model_of(results | {"workloads": others}), workload, limits)
        errors = {stage: time / seconds(workload["stages"][stage]) - 1 for stage, time in times.items()}
        found.append(errors | {"step": sum(times.values()) / seconds(workload["step"]) - 1})
    return {name: np.array([errors[name] for errors in found]) for name in found[0]}
