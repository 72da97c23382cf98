"""Explanation of the chosen number of Gaussians: size.json and its chart."""

import json
from math import log
from pathlib import Path

from clsplat.atomic import replacing
from clsplat.config import TrainConfig
from clsplat.training.autosize.rule import SURE, Search, best_degree, sh_bytes


def write_report(path: Path, search: Search, grown: int, config: TrainConfig, held: list[str]) -> None:
    """Write size.json: the rule, the names of the held-back photos, all trials and candidates, and the choice.

    grown is the number of Gaussians after the training with all photos.

    least_share is the price per doubling as one of a single Gaussian. A doubling that gains p dB lowers the squared
    error by the fraction p ln(10)/10 and is ln(2) on the natural scale of N. The last Gaussian must therefore lower
    the error by the fraction p ln(10)/(10 ln(2)) of a Gaussian's even share.
    """
    chosen = best_degree(search.degrees)
    content = {
        "rule": "growth whose gain, the median over the held-back photos, is more than its price by the margin of "
        f"{SURE:g} standard error; where it is less by as much, pruning until one loses more than its price by as "
        "much; a lower degree where the highest one gains less than its price by as much, and of these the one of "
        "the largest worth = quality - price log2(bytes)",
        "quality": "mean of PSNR and of SSIM in decibels on the held-back photos",
        "held_back": held,
        "price": config.size_price,
        "least_share": config.size_price * log(10) / (10 * log(2)),
        "chosen": {"n": chosen.n, "n_with_all_photos": grown, "sh_degree": chosen.sh_degree},
        "trials": [
            {
                "iteration": trial.larger.iteration,
                "kind": "growth" if trial.grows else "pruning",
                "n": [trial.smaller.n, trial.larger.n],
                "quality": [trial.smaller.quality, trial.larger.quality],
                "gain": trial.gain,
                "margin": trial.margin,
                "price": trial.price,
                "taken": trial.smaller.n if trial.takes_smaller else trial.larger.n,
            }
            for trial in search.trials
        ],
        "degrees": [
            {"sh_degree": p.sh_degree, "bytes": p.n * sh_bytes(p.sh_degree), "quality": p.quality, "worth": p.worth}
            for p in search.degrees
        ],
    }
    with replacing(path) as file:
        file.write(json.dumps(content, indent=1).encode())


def size_chart(report: Path, path: Path) -> None:
    """Draw the choice of the number of Gaussians as a PNG.

    Left, the quality on the held-back photos against the number of Gaussians, with the two sides of each comparison
    joined. Right, the same against the bytes, for each degree of the spherical harmonics.

    Parameters
    ----------
    report : Path
        size.json of a training run.
    path : Path
        The PNG.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    content = json.loads(report.read_text())
    chosen, degrees = content["chosen"], content["degrees"]
    figure = Figure(figsize=(9, 4.2), dpi=150, layout="constrained")
    by_n, by_bytes = figure.subplots(1, 2, width_ratios=[3, 2])
    grey, blue, orange, green = "0.55", "#0072b2", "#d55e00", "#009e73"
    labelled: set[str] = set()
    for trial in content["trials"]:
        color, label = (grey, "growth") if trial["kind"] == "growth" else (blue, "pruning")
        by_n.plot(trial["n"], trial["quality"], "-", color=color, label=None if label in labelled else label)
        labelled.add(label)
        for n, quality in zip(trial["n"], trial["quality"], strict=True):
            by_n.plot(n, quality, "o", color=color, markerfacecolor=color if n == trial["taken"] else "white")
        price = [trial["quality"][0], trial["quality"][0] + trial["price"]]
        name = f"price: {content['price']:g} dB per doubling"
        by_n.plot(trial["n"], price, "--", color=orange, linewidth=1, label=None if name in labelled else name)
        labelled.add(name)
    best = next(p for p in degrees if p["sh_degree"] == chosen["sh_degree"])
    more = f", {chosen['n_with_all_photos']:,} with all photos" * (chosen["n_with_all_photos"] > chosen["n"])
    by_n.axvline(chosen["n"], color=orange, linewidth=0.8, label=f"chosen: {chosen['n']:,}{more}")
    by_n.set_xlabel("Gaussians; two sides of a comparison joined, the full one goes on")
    by_n.set_ylabel("quality on the held-back photos, dB")
    by_bytes.plot([p["bytes"] / 1e6 for p in degrees], [p["quality"] for p in degrees], "o-", color=green)
    by_bytes.plot(best["bytes"] / 1e6, best["quality"], "*", color=orange, markersize=15, zorder=4)
    for p in degrees:
        marker = ", chosen" if p is best else ""
        right = p is degrees[0]  # the curve lies right of the first point and left of the others
        place = {"xytext": (8 if right else -10, -4), "ha": "left" if right else "right"}
        at = p["bytes"] / 1e6, p["quality"]
        by_bytes.annotate(f"degree {p['sh_degree']}{marker}", at, textcoords="offset points", **place)
    by_bytes.set_xlabel("MB, without refitting")
    by_bytes.margins(x=0.3)
    for axes in (by_n, by_bytes):
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.3g}" if x < 1000 else f"{x / 1000:,.3g}k"))
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    by_n.legend(frameon=False)
    with replacing(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})
