"""Axes of the camera frame, and positions of the pixel centres."""

import matplotlib.pyplot as plt
import numpy as np

figure, (frame, grid) = plt.subplots(1, 2, figsize=(9, 3.6), width_ratios=(1.15, 1))

# Left: an oblique view of the camera frame. The rows of `axes` are the directions of x, y and z on the paper.
axes = np.array([[0.9, -0.22], [0.0, -0.95], [0.75, 0.3]])


def paper(x, y, z):
    return np.array([x, y, z]) @ axes


for name, end in (("x, right", (1.1, 0, 0)), ("y, down", (0, 1.1, 0)), ("z, forward", (0, 0, 4.1))):
    tip = paper(*end)
    frame.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.4})
    frame.annotate(name, tip, textcoords="offset points", xytext=(5, -3))
depth = 2.4
corners = [paper(x, y, depth) for x, y in ((-0.8, -0.6), (0.8, -0.6), (0.8, 0.6), (-0.8, 0.6))]
frame.add_patch(plt.Polygon(corners, facecolor="tab:blue", alpha=0.15, edgecolor="tab:blue"))
for corner in corners:
    frame.plot([0, corner[0]], [0, corner[1]], color="tab:blue", lw=0.7, alpha=0.6)
frame.plot(0, 0, "o", color="black", ms=5)
frame.annotate("camera centre", (0, 0), textcoords="offset points", xytext=(-88, -4))
frame.annotate("pixel (0, 0)", corners[0], textcoords="offset points", xytext=(-60, 4), color="tab:blue")
point = paper(-0.45, -0.3, depth)
frame.plot(*point, "o", color="tab:red", ms=5)
frame.annotate("p", point, textcoords="offset points", xytext=(5, 4), color="tab:red")
frame.set_aspect("equal")
frame.set_xlim(-1.4, 4.3)
frame.set_ylim(-1.3, 1.7)
frame.axis("off")
frame.set_title("camera frame")

# Right: an image of 4 x 3 pixels.
width, height = 4, 3
for x in range(width + 1):
    grid.plot([x, x], [0, height], color="tab:blue", lw=0.8)
for y in range(height + 1):
    grid.plot([0, width], [y, y], color="tab:blue", lw=0.8)
u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
grid.plot(u.ravel(), v.ravel(), ".", color="black")
grid.annotate("(0.5, 0.5)", (0.5, 0.5), textcoords="offset points", xytext=(-18, -13), fontsize=8)
grid.plot(width / 2, height / 2, "+", color="tab:red", ms=11, mew=1.6)
grid.annotate("(cx, cy) = (2, 1.5)", (2, 1.5), textcoords="offset points", xytext=(4, 7), fontsize=8, color="tab:red")
grid.set_xticks(range(width + 1))
grid.set_yticks(range(height + 1))
grid.xaxis.tick_top()
grid.xaxis.set_label_position("top")
grid.set_xlabel("u in px")
grid.set_ylabel("v in px")
grid.set_xlim(-0.3, width + 0.3)
grid.set_ylim(height + 0.3, -0.3)
grid.set_aspect("equal")
for side in grid.spines.values():
    side.set_visible(False)

figure.tight_layout()
