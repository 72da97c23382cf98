"""How few Gaussians keep a scene within a loss, by the order in which they are removed: docs/howto/compact.md.

``python tests/pruning/measure_compact.py scene.ply [--photos dataset --downscale 2]``
"""

import time

import numpy as np
import tyro
from opened_scene import Arguments, opened

from clsplat.pruning.compaction import LossMeter
from clsplat.pruning.prices import price, removal_order

LOSSES = (0.1, 0.5, 1.0)


def main() -> None:
    arguments = tyro.cli(Arguments, description="Prune a scene in several orders, each to several losses.")
    gaussians, pricing, evaluation, renderer = opened(arguments)
    n = len(gaussians)
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
