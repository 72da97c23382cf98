"""The page of an evaluation."""

import html
import math
from pathlib import Path
from typing import Any
from urllib.parse import quote

from clsplat.atomic import replacing
from clsplat.show.comparisons import DIFFERENCE_MAX, palette

METRICS = {
    "psnr": ("PSNR", "dB", 2, "higher"),
    "psnr_fitted": ("PSNR, colours fitted", "dB", 2, "higher"),
    "ssim": ("SSIM", "", 3, "higher"),
    "flip": ("FLIP", "", 3, "lower"),
    "lpips": ("LPIPS", "", 3, "lower"),
}
"""Name, unit, number of decimals and better direction of each metric."""

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Evaluation of {count}</title>
<style>{style}</style>
<main>
<header class=top><h1>Evaluation of {count}</h1><p>{facts}</p></header>
<section class=tiles>{tiles}
<div class="tile wide"><h2>PSNR of each view, by name</h2><div class=bars>{bars}</div></div></section>
<section class=tools>
<p class=order hidden>Order <button data-by=worst class=on>worst first</button>
<button data-by=best>best first</button> <button data-by=name>by name</button></p>
<p class=legend>Difference, mean of the three channels
<span>0</span><i style="background:linear-gradient(to right, {steps})"></i>
<span>{full} of full scale ({steps_of_255} of 255) or more</span></p>
</section>
<section id=cards>{cards}</section>
</main>
<script>{script}</script>
"""

STYLE = """
:root { color-scheme: light dark; --page: #f6f6f4; --card: #fff; --ink: #1d1d1f; --soft: #6a6a70; --line: #e2e2de;
  --accent: #4a3aa7; }
@media (prefers-color-scheme: dark) { :root { --page: #141416; --card: #1e1e21; --ink: #ececf0; --soft: #9b9ba3;
  --line: #323237; --accent: #a99cf5; } }
* { box-sizing: border-box; margin: 0; }
body { background: var(--page); color: var(--ink); font: 15px/1.45 system-ui, sans-serif; }
main { max-width: 1800px; margin: 0 auto; padding: 28px clamp(12px, 2.5vw, 40px) 60px; }
h1 { font-size: 26px; font-weight: 650; letter-spacing: -.01em; }
.top p, .tile span, .tools, figcaption, dt { color: var(--soft); }
.tiles { display: flex; flex-wrap: wrap; gap: 12px; margin: 20px 0; }
.tile, article { background: var(--card); border: 1px solid var(--line); border-radius: 12px; }
.tile { padding: 12px 18px 14px; min-width: 190px; }
.tile h2 { font-size: 13px; font-weight: 600; color: var(--soft); }
.tile p { font-size: 34px; font-weight: 650; line-height: 1.2; font-variant-numeric: tabular-nums; }
.tile p small { font-size: 17px; font-weight: 500; color: var(--soft); }
.tile span { font-size: 12.5px; }
.wide { flex: 1 1 320px; display: flex; flex-direction: column; gap: 8px; }
.bars { flex: 1; display: flex; align-items: flex-end; gap: 2px; min-height: 58px; }
.bars a { flex: 1; max-width: 26px; height: 100%; min-height: 58px; display: flex; align-items: flex-end; }
.bars i { width: 100%; background: var(--accent); opacity: .75; border-radius: 2px 2px 0 0; }
.bars a:hover i { opacity: 1; }
.tools { display: flex; flex-wrap: wrap; justify-content: space-between; gap: 8px 24px; font-size: 13px; }
.tools p { display: flex; align-items: center; gap: 8px; }
.tools [hidden] { display: none; }
.legend { margin-left: auto; }
.legend i { width: 150px; height: 10px; border-radius: 5px; }
button { font: inherit; color: inherit; background: none; border: 1px solid var(--line); border-radius: 99px;
  padding: 2px 12px; cursor: pointer; }
button.on { background: var(--accent); border-color: var(--accent); color: var(--page); }
article { margin-top: 14px; padding: 12px 14px 10px; scroll-margin-top: 12px; }
article:target { outline: 2px solid var(--accent); }
article header { display: flex; flex-wrap: wrap; justify-content: space-between; gap: 2px 20px; margin-bottom: 8px; }
h3 { font-size: 15px; font-weight: 600; overflow-wrap: anywhere; }
dl { display: flex; gap: 6px; font-variant-numeric: tabular-nums; }
dd { font-weight: 600; margin-right: 12px; }
dd:last-child { margin-right: 0; }
dd small { font-weight: 400; font-size: inherit; color: var(--soft); }
.row { display: grid; grid-template-columns: repeat(3, 1fr); gap: 10px; }
figure a { display: block; position: relative; }
img { display: block; width: 100%; height: auto; max-height: 82vh; object-fit: contain;
  object-position: left top; border-radius: 6px; }
img + img { position: absolute; inset: 0; height: 100%; opacity: 0; }
a:hover img + img { opacity: 1; }
figcaption { font-size: 13px; padding-top: 4px; }
figcaption em { font-style: normal; opacity: .7; margin-left: 6px; }
@media (hover: none) { figcaption em { display: none; } }
@media (max-width: 700px) { .row { grid-template-columns: 1fr; } .legend { margin-left: 0; flex-wrap: wrap; } }
"""

SCRIPT = """
const cards = document.getElementById("cards"), order = document.querySelector(".order");
const by = { worst: (a, b) => a.dataset.psnr - b.dataset.psnr, best: (a, b) => b.dataset.psnr - a.dataset.psnr,
  name: (a, b) => a.dataset.index - b.dataset.index };
order.hidden = false;
order.onclick = event => {
  const key = event.target.dataset.by;
  if (!key) return;
  for (const button of order.querySelectorAll("button")) button.classList.toggle("on", button === event.target);
  cards.append(...[...cards.children].sort((a, b) => by[key](a, b) || a.dataset.index - b.dataset.index));
};
"""


def write_page(path: Path, result: dict[str, Any]) -> None:
    """Write the page of an evaluation: mean metrics, then the pictures of each view, worst view first.

    Parameters
    ----------
    path : Path
        The HTML file. It links to the pictures by the relative paths in `result`, and loads nothing else.
    result : dict
        Result of `clsplat.evaluate.evaluate`, or of `evaluate_images` with method and model_bytes.
    """
    views = result["views"]
    worst_first = sorted(range(len(views)), key=lambda k: _rank(views[k]))
    tiles = "".join(
        _tile(metric, result["mean"], views) for metric in METRICS if result["mean"].get(metric) is not None
    )
    facts = " · ".join(map(html.escape, (*_model(result), result["resolution"], result["device"])))
    steps = ", ".join(f"rgb({r} {g} {b})" for r, g, b in palette(9))
    page = PAGE.format(
        count=f"{len(views)} view{'s' if len(views) != 1 else ''}",
        facts=facts,
        tiles=tiles,
        bars="".join(_bar(view, index, views) for index, view in enumerate(views)),
        cards="".join(_card(views[index], index) for index in worst_first),
        style=STYLE,
        script=SCRIPT,
        steps=steps,
        full=f"{DIFFERENCE_MAX:.0%}",
        steps_of_255=round(DIFFERENCE_MAX * 255),
    )
    with replacing(path) as file:
        file.write(page.encode(errors="replace"))  # names of files need not be valid text


def _model(result: dict[str, Any]) -> tuple[str, ...]:
    """Facts of Gaussians, or of a radiance field."""
    if "method" in result:
        return result["method"], f"{result['model_bytes'] / 1e6:.3g} MB"
    return f"{result['num_gaussians']:,} Gaussians", f"SH degree {result['sh_degree']}", result["mode"]


def _rank(view: dict[str, Any]) -> float:
    return math.inf if view["psnr"] is None else view["psnr"]


def _figure(metric: str, value: float | None) -> str:
    """A value with its unit. None stands for the infinite PSNR of equal images."""
    _, unit, decimals, _ = METRICS[metric]
    text = "∞" if value is None else f"{value:.{decimals}f}"
    return f"{text}<small> {unit}</small>" if unit else text


def _tile(metric: str, mean: dict[str, Any], views: list[dict[str, Any]]) -> str:
    name, _, decimals, better = METRICS[metric]
    values = [view[metric] for view in views if view[metric] is not None]
    spread = f"{min(values):.{decimals}f} to {max(values):.{decimals}f}, {better} is better" if values else ""
    return f"<div class=tile><h2>Mean {name}</h2><p>{_figure(metric, mean[metric])}</p><span>{spread}</span></div>"


def _bar(view: dict[str, Any], index: int, views: list[dict[str, Any]]) -> str:
    top = max((v["psnr"] for v in views if v["psnr"] is not None), default=1.0)
    height = min(max(_rank(view) / top, 0), 1) if top > 0 else 1
    label = f"{html.escape(view['name'])}: {'∞' if view['psnr'] is None else format(view['psnr'], '.2f')} dB"
    return f'<a href="#view-{index}" title="{label}"><i style="height:{height:.1%}"></i></a>'


def _card(view: dict[str, Any], index: int) -> str:
    name = html.escape(view["name"])
    figures = "".join(
        f"<dt>{METRICS[metric][0]}</dt><dd>{_figure(metric, view[metric])}</dd>"
        for metric in METRICS
        if metric.startswith("psnr") or view.get(metric) is not None
    )
    size = f"width={view['width']} height={view['height']} loading=lazy"
    files = {kind: quote(view[kind]) for kind in ("truth", "render", "difference")}
    pictures = "".join(
        f'<figure><a href="{files[kind]}"><img src="{files[kind]}" {size} alt="{alt}: {name}">{over}</a>'
        f"<figcaption>{caption}</figcaption></figure>"
        for kind, alt, over, caption in (
            ("truth", "Photo", "", "Photo"),
            (
                "render",
                "Render",
                f'<img src="{files["truth"]}" {size} alt="">',
                "Render <em>hover to see the photo</em>",
            ),
            ("difference", "Difference", "", "Difference"),
        )
    )
    rank = f'data-psnr="{str(_rank(view)).replace("inf", "Infinity")}" data-index="{index}"'
    return (
        f'<article id="view-{index}" {rank}><header><h3>{name}</h3><dl>{figures}</dl></header>'
        f"<div class=row>{pictures}</div></article>"
    )
