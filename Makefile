# `make demo` and `make test` do everything on a machine with Python >= 3.11 and make.
PYTHON ?= python3
VENV ?= .venv
# installed versions are those that CI tested
PIP_FLAGS ?= --constraint constraints.txt
# Python compiles modules when it first imports them; most of those installed it never does
INSTALL = $(BIN)/pip install --quiet --no-compile
BIN := $(VENV)/bin

# the oldest pycolmap that works, in a folder to import from before the environment's own
OLDEST := 3.13.0
OLD := $(VENV)/pycolmap-$(OLDEST)

# tests of stages that read or write models and databases, or estimate
STAGES_OF_COLMAP := from_colmap localize_sfm more_pairs pairs_from_covisibility \
	pairs_from_verification reconstruction to_colmap triangulation

# Without bytecode, which some environments do not write, each process compiles all that it imports:
# 16 s of each worker.
export PYTHONDONTWRITEBYTECODE :=

# Workers take files in alphabetical order; in pytest-xdist's own order the slowest come last. Four
# keep two cores busy, because some tests wait.
WORKERS := -n 4 --dist loadfile --no-loadscope-reorder

.PHONY: demo test types suite check test-long results results-quick docs lint clean
.DELETE_ON_ERROR:

demo: $(VENV)/installed
	$(BIN)/python -m pipelines.aachen --feature colmap_sift_sv64 --demo

# what a developer runs after each change
test: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) --jobs 2 types suite

types: $(VENV)/installed
	$(BIN)/mypy

suite: $(VENV)/installed
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(WORKERS) -m 'not long and not check'

# what CI runs after `make test`: clusters, browsers, kills, installations, the oldest pycolmap
check: $(VENV)/installed $(OLD)/installed
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(WORKERS) -m 'check and not long'
	PYTHONPATH=$(abspath $(OLD)) $(BIN)/python -c 'import pycolmap; assert pycolmap.__version__ == "$(OLDEST)"'
	OMP_NUM_THREADS=1 PYTHONPATH=$(abspath $(OLD)) $(BIN)/python -m pytest $(WORKERS) \
		tests/models/test_dog.py tests/mapping tests/localization/test_intrinsics.py \
		$(STAGES_OF_COLMAP:%=tests/stages/test_%.py) \
		tests/maps/test_localizer.py \
		tests/hlm/test_compact.py::test_a_file_localizes_as_its_map \
		tests/hlm/test_compact.py::test_files_of_stages \
		tests/maps/test_photos_alone.py::test_photos_alone \
		tests/pipelines/test_aachen.py::test_plane tests/pipelines/test_inloc.py::test_plane

test-long: $(VENV)/installed
	$(BIN)/python -m pytest -m long

# the site, with the reference of the API; a warning is an error
docs: $(VENV)/installed
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -c docs . build/docs
	cp build/docs/README.html build/docs/index.html

# all that the documentation shows, in hours; rows of results/ that exist are kept
results: $(VENV)/installed
	PYTHON=$(BIN)/python results/run.sh

# a part again, in ten minutes
results-quick: $(VENV)/installed
	$(BIN)/python -m benchmarks.accuracy results/quick.yaml --again
	$(BIN)/python -m benchmarks.render
	git diff --stat results docs README.md

# torch by itself first: a pinned version is a CPU build where an index offers one
$(VENV)/installed: pyproject.toml setup.py hloc_reduce/utils/best_two.cpp constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) $$(grep '^torch==' constraints.txt)
	$(INSTALL) $(PIP_FLAGS) --editable '.[dev]'
	touch $@

$(OLD)/installed: $(VENV)/installed
	$(INSTALL) --no-deps --upgrade --target $(OLD) pycolmap==$(OLDEST)
	touch $@

lint: $(VENV)/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info
