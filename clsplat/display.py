"""HTML for the display of objects in notebooks, from plain values and arrays.

The HTML inherits the text colour of the page, so that it is legible on white and on black. It contains its images and
loads nothing. Pillow is imported only when an image is made.
"""

import base64
import html
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

THUMBNAIL = 84
"""Height of a thumbnail, px. Eight thumbnails fill the column of a notebook."""

PLAN = 230
"""Edge of a plan, px."""

PLAN_POINTS = 1500
"""Approximate number of points in a plan, so that its HTML stays below 100 kB."""

BINS = 32
"""Number of bars of a histogram."""


def facts(title: str, rows: Mapping[str, str], *extras: str) -> str:
    """Make a title and a table of names and values, with further HTML to the right of it."""
    body = "".join(
        f'<tr><td style="text-align:left;opacity:.65;padding:0 1em 0 0">{html.escape(name)}</td>'
        f'<td style="text-align:left;padding:0">{html.escape(value)}</td></tr>'
        for name, value in rows.items()
    )
    table = (
        f'<div><strong>{html.escape(title)}</strong><table style="margin:.3em 0;border:none;font-size:.9em">'
        f"{body}</table></div>"
    )
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:.5em 1.6em;align-items:flex-start;line-height:1.45">'
        f"{table}{''.join(extras)}</div>"
    )


def figure(content: str, caption: str) -> str:
    """Put a caption in small text under HTML."""
    return f'<div>{content}<div style="font-size:.78em;opacity:.65">{html.escape(caption)}</div></div>'


def numbers(values: Any) -> str:
    """Format a few numbers with three digits."""
    return ", ".join(f"{v:.3g}" for v in np.ravel(values))


def png(image: Array) -> bytes:
    """Encode an image (H, W, 3) as PNG: uint8, or floats, of which the range [0, 1] is shown; NaN becomes black."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(_bytes(image)).save(file, "PNG")
    return file.getvalue()


def thumbnail(image: Array, title: str) -> str:
    """Make a small copy of an image, with a title that appears when the mouse points at it."""
    from PIL import Image

    small = Image.fromarray(_bytes(image))
    small.thumbnail((4 * THUMBNAIL, THUMBNAIL))
    file = io.BytesIO()
    small.save(file, "JPEG", quality=85)
    data = base64.b64encode(file.getvalue()).decode()
    label = html.escape(title, quote=True)
    return f'<img src="data:image/jpeg;base64,{data}" title="{label}" alt="{label}" style="margin:2px">'


def histogram(values: Array, low: float, high: float, caption: str) -> str:
    """Draw a histogram over [low, high]; values outside count in the outermost bars."""
    counts, _ = np.histogram(np.clip(values, low, high), BINS, (low, high))
    top = max(int(counts.max()), 1)
    bars = "".join(
        f'<rect x="{6 * k}" y="{48 - h:.1f}" width="5" height="{h:.1f}"/>'
        for k, h in enumerate(48 * counts / top)
        if h > 0
    )
    svg = (
        f'<svg width="{6 * BINS}" height="50" fill="currentColor" opacity=".75">{bars}'
        f'<rect x="0" y="49" width="{6 * BINS}" height="1"/></svg>'
    )
    ends = f"{low:.3g}<span style='float:right'>{high:.3g}</span>"
    return figure(f'{svg}<div style="font-size:.78em;opacity:.65;width:{6 * BINS}px">{ends}</div>', caption)


def plan(eyes: Array, gazes: Array, held_out: NDArray[np.bool_], points: Array, colors: Array) -> str:
    """Draw a plan of cameras and points, which are already projected to a plane.

    Parameters
    ----------
    eyes, gazes : (V, 2)
        Positions and viewing directions of the cameras, y up.
    held_out : (V,) bool
        Whether each camera is held out; these are drawn hollow.
    points : (P, 2)
        Positions of the points.
    colors : (P, 3) uint8
        RGB of the points.
    """
    points, colors = points[:: -(-len(points) // PLAN_POINTS) or 1], colors[:: -(-len(colors) // PLAN_POINTS) or 1]
    centre = (eyes.min(axis=0) + eyes.max(axis=0)) / 2
    reach = max(float(np.abs(eyes - centre).max()), 1e-12) * 1.25
    scale = PLAN / 2 / reach

    def at(xy: Array) -> Array:
        return PLAN / 2 + (xy - centre) * scale * [1, -1]

    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1" fill="rgb({r},{g},{b})"/>'
        for (x, y), (r, g, b) in zip(at(points), colors, strict=True)
        if 0 <= x <= PLAN and 0 <= y <= PLAN
    )
    fills = np.where(held_out, "none", "currentColor")
    marks = "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + 11 * u:.1f}" y2="{y - 11 * v:.1f}" stroke="currentColor"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" stroke="currentColor" fill="{fill}"/>'
        for (x, y), (u, v), fill in zip(at(eyes), gazes, fills, strict=True)
    )
    return f'<svg width="{PLAN}" height="{PLAN}">{dots}{marks}</svg>'


def _bytes(image: Array) -> NDArray[np.uint8]:
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    return np.rint(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
