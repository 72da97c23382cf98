"""How few Gaussians keep a scene within a loss, by the order in which they are removed: docs/howto/compact.md.

``python tests/pruning/measure_compact.py scene.ply [--photos dataset --downscale 2]``
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from clsplat.commands.compact import Compact
from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.formats import load_gaussians
from clsplat.pruning.compaction import LossMeter
from clsplat.pruning.prices import price, removal_order
from clsplat.renderer import Renderer

LOSSES = (0.1, 0.5, 1.0)


@dataclass(frozen=True)
class Arguments:
    """Prune a scene in several orders, each to several losses."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    photos: Path | None = None
    """Dataset, as given to `train`; without it automatic viewpoints."""
    data: tyro.conf.OmitArgPrefixes[DataConfig] = field(default_factory=DataConfig)


def main() -> None:
    arguments = tyro.cli(Arguments, description=Arguments.__doc__)
    gaussians, mode, _ = load_gaussians(arguments.scene)
    n = len(gaussians)
    renderer = Renderer(Device(), RenderConfig(mode=mode), BACKGROUNDS[arguments.data.background])
    scene = None if arguments.photos is None else load_scene(arguments.photos, arguments.data)
    command = Compact(arguments.scene, Path("-"), photos=arguments.photos, data_config=arguments.data)
    pricing, evaluation = command._views(gaussians, scene, renderer)
    measured = LossMeter(gaussians, evaluation, arguments.photos is not None, renderer)

    def fewest(order: np.ndarray, loss: float) -> int:
        low, high = 1, n
        while high / low > 1.01 and high > low + 1:
            middle = int(np.sqrt(low * high))
            low, high = (low, middle) if measured(gaussians.take(np.sort(order[:middle]))) <= loss else (middle, high)
        return high

    started = time.perf_counter()
    prices = price(gaussians, pricing, renderer)
    once = time.perf_counter() - started
    orders = {
        "opacity": np.argsort(-gaussians.opacities, kind="stable"),
        "sum of weights": np.argsort(-prices.weights, kind="stable"),
        "price, once": np.argsort(-prices.differences, kind="stable"),
    }

    def done(left: object) -> bool:
        return measured(left) > LOSSES[-1]

    orders["price, in rounds"] = removal_order(gaussians, pricing, done, renderer)
    seconds = time.perf_counter() - started
    print(f"{arguments.scene.name}: {n} Gaussians, {len(pricing)} views price, {len(evaluation)} measure the loss")
    print(f"prices once {once:.0f} s, in rounds {seconds:.0f} s")
    for name, order in orders.items():
        counts = [fewest(order, loss) for loss in LOSSES]
        print(f"| {name} | " + " | ".join(f"{c} ({100 * c / n:.0f} %)" for c in counts) + " |", flush=True)


if __name__ == "__main__":
    main()
