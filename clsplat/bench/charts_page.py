"""Charts of `clsplat bench quality` as files, and together on one page that works without a network."""

import base64
import html
import io
from pathlib import Path
from typing import TYPE_CHECKING

from clsplat.atomic import replacing
from clsplat.bench.charts import published_chart, published_table, quality_chart
from clsplat.bench.quality_summary import COSTS, METRICS, failures, measured_metrics, origins, runs, table, verdict
from clsplat.bench.results import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = {
    "seconds": "time",
    "cpu_seconds": "processor-time",
    "num_gaussians": "gaussians",
    "spz_bytes": "bytes",
    "memory_bytes": "memory",
    "fps": "speed",
}
"""Names of the costs in file names of charts."""

NOTES = {
    "seconds": "Wall time of the training, without evaluation, reading the photos and building the kernels. Before "
    "the end, learning rates are those of a training that continues.",
    "cpu_seconds": "Processor time of the training on all cores of the host. Other work on the machine lengthens "
    "wall times, but hardly processor times. If a GPU trains, this is the host's part only.",
    "num_gaussians": "Number at the end of the training.",
    "spz_bytes": "Size of the file at the end of the training: .spz for Gaussians, whose .ply is up to ten times as "
    "large, and .npz for a radiance field.",
    "memory_bytes": "Peak of the buffers on the device during the training, photos included.",
    "fps": "Reciprocal of the median time from a held-out camera to its image in the host's memory.",
}
"""Explanation of each cost on the page."""

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Quality against its costs</title>
<style>{style}</style>
<noscript><style>.metric {{ display: block !important; }} nav .by {{ display: none; }}</style></noscript>
<body data-metric="{first}">
<main>
<h1>Quality against its costs</h1>
<ul class=facts>{facts}</ul>
<nav>{links}<span class=by>Quality by {buttons}</span></nav>
{sections}
</main>
<script>{script}</script>
"""

STYLE = """
:root { --page: #f6f6f4; --card: #fff; --ink: #1d1d1f; --soft: #6a6a70; --line: #e2e2de; --accent: #4a3aa7; }
* { box-sizing: border-box; margin: 0; }
body { background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px clamp(12px, 2.5vw, 40px) 60px; }
h1 { font-size: 26px; font-weight: 650; letter-spacing: -.01em; }
h2 { font-size: 18px; font-weight: 650; }
.facts { color: var(--soft); font-size: 13px; padding: 6px 0 0 18px; }
nav { position: sticky; top: 0; z-index: 1; background: var(--page); padding: 12px 0; display: flex; flex-wrap: wrap;
  gap: 6px 18px; align-items: center; border-bottom: 1px solid var(--line); }
nav a { color: var(--accent); text-decoration: none; }
.by { margin-left: auto; color: var(--soft); }
button { font: inherit; color: inherit; background: none; border: 1px solid var(--line); border-radius: 99px;
  padding: 2px 12px; cursor: pointer; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 12px; padding: 16px 18px;
  margin-top: 16px; scroll-margin-top: 60px; }
section > p { color: var(--soft); font-size: 13.5px; }
.metric { display: none; }
.metric img { display: block; width: 100%; height: auto; margin: 8px 0; }
.metric ul { padding-left: 18px; font-size: 13.5px; }
.scroll { overflow-x: auto; margin-top: 12px; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; white-space: nowrap; }
th, td { text-align: left; padding: 4px 18px 4px 0; border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--soft); }
td:first-child { font-weight: 600; }
"""

SHOW = """
body[data-metric={metric}] .{metric} {{ display: block; }}
body[data-metric={metric}] [data-show={metric}] {{ background: var(--accent); color: #fff; }}
"""

SCRIPT = """
document.querySelector("nav").onclick = event => {
  const metric = event.target.dataset.show;
  if (metric) document.body.dataset.metric = metric;
};
"""


def write_charts(records: list[Record], out: Path) -> None:
    """Draw all charts of the results, as PNG, as SVG and on the page index.html.

    Parameters
    ----------
    records : list of dict
        Result of `clsplat.bench.results.read_records`.
    out : Path
        Folder for the files.
    """
    finished = runs(records)
    metrics = measured_metrics(finished)
    sections = []
    for cost in COSTS if finished else ():
        shown = [
            _figure(metric, quality_chart(finished, cost, metric), out / f"{NAMES[cost]}-{metric}")
            + _list(verdict(finished, cost, metric))
            for metric in metrics
        ]
        sections.append(_section(NAMES[cost], COSTS[cost].name, NOTES[cost], metrics, shown, table(finished, cost)))
    failed = failures(records)
    if failed:
        rows = [["training", "reason"], *map(list, failed)]
        sections.append(f"<section id=failed><h2>Failed</h2>{_table(rows)}</section>")
    shown = [
        _figure(metric, published_chart(metric if metric != "flip" else "psnr"), out / f"published-{metric}")
        for metric in metrics
    ]
    note = "Measured on other scenes and other hardware: these figures cannot be compared with those above."
    sections.append(_section("published", "Published by Kerbl et al. 2023", note, metrics, shown, published_table()))
    links = {NAMES[cost]: COSTS[cost].name for cost in COSTS if finished}
    links |= {"failed": "failed"} if failed else {}
    links |= {"published": "published"}
    page = PAGE.format(
        first=next(iter(metrics), "psnr"),
        style=STYLE + "".join(SHOW.format(metric=metric) for metric in metrics),
        facts="".join(f"<li>{html.escape(line)}</li>" for line in origins(records)),
        links="".join(f'<a href="#{name}">{html.escape(text)}</a>' for name, text in links.items()),
        buttons=" ".join(f"<button data-show={metric}>{METRICS[metric].name}</button>" for metric in metrics),
        sections="\n".join(sections),
        script=SCRIPT,
    )
    with replacing(out / "index.html") as file:
        file.write(page.encode())


def _section(name: str, heading: str, note: str, metrics: list[str], shown: list[str], rows: list[list[str]]) -> str:
    charts = "".join(
        f'<div class="metric {metric}">{part}</div>' for metric, part in zip(metrics, shown, strict=True)
    )
    text = heading[0].upper() + heading[1:]
    return f"<section id={name}><h2>{text}</h2><p>{html.escape(note)}</p>{charts}{_table(rows)}</section>"


def _figure(metric: str, figure: "Figure", path: Path) -> str:
    """Write a chart as PNG and SVG, and return the HTML that embeds the SVG in the page."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    svg = drawn.getvalue()
    with replacing(path.with_suffix(".svg")) as file:
        file.write(svg)
    with replacing(path.with_suffix(".png")) as file:
        figure.savefig(file, format="png", metadata={"Software": None})
    source = base64.b64encode(svg).decode()
    return f'<img alt="{METRICS[metric].name}: {path.name}" src="data:image/svg+xml;base64,{source}">'


def _list(sentences: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(sentence)}</li>' for sentence in sentences)}</ul>"


def _table(rows: list[list[str]]) -> str:
    head, *body = rows
    cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    lines = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in body)
    return f"<div class=scroll><table><thead><tr>{cells}</tr></thead><tbody>{lines}</tbody></table></div>"
