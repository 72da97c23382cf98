.PHONY: test test-slow lint docs check-races

# The default tests: a few minutes on two cores.
test:
	python -m pytest -m "not slow"

# Trainings, which take minutes each.
test-slow:
	python -m pytest -m slow

# Style, types, and the kernels' format.
lint:
	ruff check clsplat tests
	ruff format --check clsplat tests
	mypy
	clang-format --dry-run --Werror cl/*.cl cl/*.h

# The documentation, as pages in docs/_build/html; needs the extra `docs`.
docs:
	python -m sphinx -W -b html docs docs/_build/html

# The kernels under the simulator Oclgrind: data races, divergent barriers, accesses out of bounds.
check-races:
	python -m pytest tests/check_races.py
