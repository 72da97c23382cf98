"""Every known failure has an experiment, and thus a row on the page Stability. It is open if there is no remedy."""

import pytest
from scene_experiments import ALL_EXPERIMENTS, SCENE_EXPERIMENTS

from clsplat.bench.stability import EXPERIMENTS

FAILURES = {
    "singular covariance, zero quaternion, Inf/NaN parameters": ["poisoning", "needles"],
    "Jacobian off the frustum and at the near plane": ["jacobian"],
    "wide-angle projection error": ["wide-angle"],
    "dilation and aliasing at other scales": ["scales"],
    "popping when turning": ["popping"],
    "needles": ["effective-rank"],
    "forward/backward constants differ, saturated alpha": ["constants"],
    "opacity reset": ["opacity-reset"],
    "everything pruned": ["everything-pruned"],
    "densification blow-up, out of memory": ["blow-up"],
    "dead Gaussians left by MCMC": ["dead-gaussians"],
    "few views": ["few-views"],
    "no points (random start)": ["random-start"],
    "exposure changes": ["exposure"],
    "wrong or NaN poses, reflected rotation": ["poses"],
    "geo-referenced coordinates": ["world-offset"],
    "equal depths": ["equal-depths"],
    "runs that differ": ["repeated-runs"],
    "SH extrapolation": ["sh-extrapolation"],
    "dark areas turning transparent": ["dark-areas"],
    "floaters near cameras": ["floaters", "outermost"],
    "images of mixed size, orientation, EXIF rotation, 16-bit, grey, RGBA, CMYK, corrupt": ["images"],
    "wrong intrinsics": ["focal-length"],
    "moving objects": ["moving-object"],
}
"""Failures known from papers and issue threads, with the experiments that measure them."""

OPEN = {"focal-length"}
"""Experiments on failures without a remedy."""


@pytest.mark.parametrize("failure", FAILURES)
def test_a_failure_is_measured(failure):
    assert set(FAILURES[failure]) <= set(ALL_EXPERIMENTS)


def test_the_lists_of_failures_and_of_open_ones_are_complete():
    assert {name for names in FAILURES.values() for name in names} == set(ALL_EXPERIMENTS)
    assert {name for name, experiment in ALL_EXPERIMENTS.items() if experiment.remedy is None} == OPEN


def test_the_page_shows_the_packaged_experiments_and_those_on_real_scenes():
    assert not set(EXPERIMENTS) & set(SCENE_EXPERIMENTS)
    assert set(ALL_EXPERIMENTS) == set(EXPERIMENTS) | set(SCENE_EXPERIMENTS)
