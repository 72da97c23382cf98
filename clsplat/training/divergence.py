"""Divergence: a training whose numbers stop being finite ends with a sentence, and its last checkpoint stays."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from clsplat import reference
from clsplat.errors import ClsplatError
from clsplat.stages import Stages
from clsplat.training.state import State


def check_loss(loss: float, iteration: int, out: Path) -> None:
    """Raise a ClsplatError if the loss of an iteration is not finite."""
    if not np.isfinite(loss):
        raise _diverged(f"the loss of iteration {iteration} is {loss}", out)


def check_state(state: State, stages: Stages, out: Path) -> None:
    """Check all parameters and their moments where they are.

    The loss alone does not show that they are finite: a Gaussian that is not is left out of the image.

    Parameters
    ----------
    state : State
    stages : Stages
        Those of the device, for arrays that are there.
    out : Path
        Folder of the run, for the message.

    Raises
    ------
    ClsplatError
        If a value is not finite; the message names the parameter and the iteration.
    """
    for name, array in _arrays(state):
        at = reference if isinstance(array, np.ndarray) else stages
        if count := at.count_not_finite(array):
            raise _diverged(
                f"{name} after iteration {state.iteration}: {count} of {array.size} values are not finite", out
            )


def _arrays(state: State) -> Iterator[tuple[str, Any]]:
    yield from state.gaussians.arrays().items()
    for which, moments in (("first", state.moments.first), ("second", state.moments.second)):
        for name, array in moments.arrays().items():
            yield f"Adam's {which} moments of {name}", array
    for name, learned in (("the photos' exposures", state.exposures), ("the photos' poses", state.poses)):
        if learned:
            yield name, learned.values


def _diverged(what: str, out: Path) -> ClsplatError:
    return ClsplatError(
        f"training diverged: {what}; lower the learning rates (--optim.*); the last checkpoint in {out}, if there is "
        "one, is intact"
    )
