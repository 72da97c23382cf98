"""When a strategy that grows to a cap has its rounds, and how many Gaussians there are after each."""

from clsplat.config import ErrorConfig, McmcConfig, TrainConfig
from clsplat.errors import InputError


class Schedule:
    """Rounds every so many iterations, and growth by equal factors.

    Raises
    ------
    InputError
        If there is no cap to grow to.
    """

    def __init__(self, config: TrainConfig, settings: McmcConfig | ErrorConfig) -> None:
        if config.max_gaussians is None:
            raise InputError(
                f"--max-gaussians: expected with --strategy {config.strategy}, which grows to that number, found none"
            )
        self.every, self.growth = settings.every, settings.growth
        self.start = config.shortened(settings.start)
        self.full = round(settings.full_fraction * config.iterations)
        self.stop = round(settings.stop_fraction * config.iterations)

    def due(self, iteration: int) -> bool:
        """Whether a round is due after an iteration, counted from 1."""
        return self.start <= iteration < self.stop and iteration % self.every == 0

    def size_after(self, iteration: int, n: int, cap: int) -> int:
        """Gaussians after a round that began with n: a fixed fraction more, and no less than takes them to the cap by
        equal factors in the rounds until it is to be full; none are taken away."""
        if n >= cap:
            return n
        rounds = max(1, self.full // self.every - iteration // self.every + 1)
        return min(cap, round(n * max(1 + self.growth, (cap / n) ** (1 / rounds))))
