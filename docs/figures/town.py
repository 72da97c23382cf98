"""Time and memory of a training in blocks over the number of photos, as measured by tests/blocks/measure_town.py."""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

results = json.loads(Path("../results/town.json").read_text())  # the working directory is this file's
photos = np.array([int(count) for count in results])


def values(name):
    """One figure of all numbers of photos."""
    return np.array([one[name] for one in results.values()], float)


figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8))
seconds = values("processor seconds")
power = np.polyfit(np.log(photos), np.log(seconds), 1)[0]
left.plot(photos, seconds, "o-", color="tab:blue", label=f"measured: power {power:.2f} of the photos")
left.plot(photos, seconds[0] * photos / photos[0], "--", color="0.6", label="in proportion to the photos")
left.set_ylabel("processor time, s")
left.set_yscale("log")
left.set_yticks([50, 100, 200, 500], ["50", "100", "200", "500"])

right.plot(photos, values("MB needed at once"), "--", color="0.6", label="device, if trained at once (predicted)")
right.plot(photos, values("MB resident"), "s-", color="tab:orange", label="host, largest resident size")
right.plot(photos, values("MB on the device"), "o-", color="tab:blue", label="device, largest")
right.plot(photos, values("MB limit"), ":", color="tab:red", label="device, limit")
right.set_ylabel("memory, MB")
right.set_yscale("log")
right.set_ylim(5, 2500)
right.set_yticks([10, 30, 100, 300], ["10", "30", "100", "300"])

for ax in (left, right):
    ax.set_xscale("log")
    ax.set_xticks(photos, [str(count) for count in photos])
    ax.minorticks_off()
    ax.set_xlabel("photos")
    ax.grid(color="0.9")
    ax.legend(fontsize=8, loc="upper left")
figure.tight_layout()
