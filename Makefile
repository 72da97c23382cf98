.PHONY: check-races docs

# The kernels under the simulator Oclgrind: data races, divergent barriers, accesses out of bounds.
check-races:
	python -m pytest tests/check_races.py

# The documentation, as pages in docs/_build/html; needs the extra `docs`.
docs:
	python -m sphinx -W -b html docs docs/_build/html
