"""Tiles that the exact test keeps, compared with those of a box around the splat."""

import matplotlib.pyplot as plt
import numpy as np

from clsplat.constants import ALPHA_MIN, TILE
from clsplat.reference import bin_splats
from clsplat.stages import Splats

width, height = 10 * TILE, 6 * TILE
centre, opacity = np.array([82.0, 47.0]), 0.8
cov = np.array([[360.0, -190.0], [-190.0, 130.0]])
conic = np.linalg.inv(cov)
extent = np.sqrt(2 * np.log(opacity / ALPHA_MIN) * np.diag(cov))
splat = Splats(
    centre[None], conic[[0, 0, 1], [0, 1, 1]][None], np.ones(1), extent[None], np.array([opacity]), np.ones((1, 3))
)
kept = np.diff(bin_splats(splat, width, height, TILE).tile_ranges, axis=1).reshape(height // TILE, -1) > 0

figure, ax = plt.subplots(figsize=(7, 4.3))
dx, dy = np.meshgrid(np.arange(width) + 0.5 - centre[0], np.arange(height) + 0.5 - centre[1])
sigma = 0.5 * (conic[0, 0] * dx**2 + conic[1, 1] * dy**2) + conic[0, 1] * dx * dy
alpha = opacity * np.exp(-sigma)
ax.imshow(np.where(alpha >= ALPHA_MIN, alpha, np.nan), cmap="Blues", vmax=1, extent=(0, width, height, 0))
ax.contour(dx + centre[0], dy + centre[1], alpha, levels=[ALPHA_MIN], colors="tab:blue", linewidths=1)
for ty, tx in np.argwhere(kept):
    ax.add_patch(plt.Rectangle((tx * TILE, ty * TILE), TILE, TILE, facecolor="tab:orange", alpha=0.25))
ax.add_patch(plt.Rectangle(centre - extent, *(2 * extent), fill=False, edgecolor="tab:red", ls="--"))
first, last = np.floor((centre - extent) / TILE), np.ceil((centre + extent) / TILE)
last = np.minimum(last, [width // TILE, height // TILE])
boxed = int(np.prod(last - np.maximum(first, 0)))
ax.set_xticks(range(0, width + 1, TILE))
ax.set_yticks(range(0, height + 1, TILE))
ax.grid(color="0.6", lw=0.6)
ax.set_title(f"the exact test keeps {kept.sum()} tiles, the box of the extents meets {boxed}", fontsize=10)
figure.tight_layout()
