"""Cells of `clsplat bench quality` that train in seconds."""

from pathlib import Path

from clsplat.bench.cells import Cell, make_cells

ITERATIONS = 12


SMALL = {"iterations": ITERATIONS, "init": {"random_points": 150, "sh_degree": 1}}


def cells_of(data: Path, *methods: str, scenes: tuple[str, ...] = ("one",)) -> list[Cell]:
    return make_cells([str(data / s) for s in scenes], [str(data / f"{m}.json") for m in methods], ["own"], [])
