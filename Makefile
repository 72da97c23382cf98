.PHONY: check-races

# The kernels under the simulator Oclgrind: data races, divergent barriers, accesses out of bounds.
check-races:
	python -m pytest tests/check_races.py
