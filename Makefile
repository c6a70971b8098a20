# make paper   the environment, the training, the studies, the report in runs/paper/
# make test    the environment, then style and tests
# make test-quick   a part of the tests, in a minute once the kernels are compiled
# make test-of   the tests that reach FILE (or a folder), nearest first, within NEAR imports if given; ends at the first failure
# make test-slow   the tests that make test leaves out: strict types, deployments over TLS, kills, trainings
# make test-bounds   the tests of the kernels, compiled with a check of every index, in a cache of their own
# make test-lower   a part of the tests with the least version of each dependency, without torch, in build/lower
# make fuzz    every text reader under coverage-guided fuzzing, MINUTES each (default 10); finds go to build/fuzz
# make docs    the site in build/site, tutorials executed; a warning is an error
# make benchmark   every benchmark, its ratios against benchmarks/baseline.json
# make release   wheel, sdist, what they need (CycloneDX; requirements.txt with hashes) in dist/, built twice and compared
# make clean   forget the environment (results in runs/ stay)
#
# TORCH_INDEX: where the package index serves torch's CUDA build (several GB; it works, too), name an index of CPU builds:
#   make paper TORCH_INDEX=https://download.pytorch.org/whl/cpu
PYTHON ?= python3
TORCH_INDEX ?=
JOBS ?= 2
MINUTES ?= 10
VENV := .venv
READY := $(VENV)/.ready
PIP := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt \
	$(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

PYTEST := OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n $(JOBS) --dist loadfile
QUICK := $(patsubst %,tests/test_%.py,world misuse star_filters kernels_vectors formats formats_errors data_readers data_log \
	optimize_problem optimize_agreement statistics study_results study_grid layering)

LOWER := build/lower

.PHONY: paper test test-quick test-of test-slow test-bounds test-lower fuzz docs benchmark release help clean

paper: $(READY)
	$(VENV)/bin/coopoc paper --out runs/paper --jobs $(JOBS)

test: $(VENV)/.ready-dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(PYTEST) -m "not slow"

test-quick: $(VENV)/.ready-dev
	$(PYTEST) $(QUICK)

test-of: $(VENV)/.ready-dev
	@tests=$$($(VENV)/bin/python tests/of.py $(FILE) $(NEAR)); test -n "$$tests" || { echo "No test imports FILE=$(FILE)."; exit 1; }; \
	$(PYTEST) --no-loadscope-reorder -x -m "not slow" $$tests

test-slow: $(VENV)/.ready-dev
	$(PYTEST) -m slow tests

test-bounds: $(VENV)/.ready-dev
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(abspath $(VENV))/bounds OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest \
		-n $(JOBS) --dist loadfile tests/test_memory_safety.py tests/test_star_filters.py tests/test_solo_filters.py tests/test_kernels_scores.py

test-lower:
	$(PYTHON) -m venv $(LOWER)
	$(PYTHON) tests/lower_bounds.py > $(LOWER)/constraints.txt
	$(LOWER)/bin/python -m pip install --quiet -c $(LOWER)/constraints.txt setuptools wheel
	$(LOWER)/bin/python -m pip install --quiet -c $(LOWER)/constraints.txt --no-build-isolation --editable . \
		pytest pytest-xdist filterpy pymap3d
	NUMBA_CACHE_DIR=$(abspath $(LOWER))/cache OMP_NUM_THREADS=1 $(LOWER)/bin/python -m pytest \
		-n $(JOBS) --dist loadfile $(QUICK)

fuzz: $(VENV)/.ready-fuzz
	export OMP_NUM_THREADS=1 PYTHONPATH=tests; $(VENV)/bin/python -c "from fuzz.readers import READERS as r; print(*r, sep='\n')" | \
	while read -r name; do $(VENV)/bin/python -m fuzz.run "$$name" --minutes $(MINUTES); done

docs: $(VENV)/.ready-docs
	NO_MKDOCS_2_WARNING=1 TQDM_DISABLE=1 OMP_NUM_THREADS=1 $(VENV)/bin/python -m mkdocs build

help:
	@sed -n 's/^# \(make [a-z-]* .*\)/\1/p' Makefile

# The same commit gives the same bytes: times are the commit's, and the sdist is packed anew, as setuptools keeps those of
# the files.
release: export SOURCE_DATE_EPOCH := $(shell git log -1 --format=%ct)
release: $(READY)
	$(PIP) build cyclonedx-bom setuptools wheel
	rm -rf dist build/first build/lib
	for out in build/first dist; do \
		$(VENV)/bin/python -m build --no-isolation --outdir $$out . && rm -rf build/lib build/bdist.* && cd $$out && \
		tar xzf *.tar.gz && name=$$(basename *.tar.gz .tar.gz) && tar --sort=name --mtime=@$$SOURCE_DATE_EPOCH --owner=0 \
		--group=0 --numeric-owner --format=ustar -cf - $$name | gzip -9n > $$name.tar.gz && rm -r $$name && cd $(CURDIR) || exit 1; \
	done
	cd dist && sha256sum coopoc-* | tee SHA256SUMS && cd ../build/first && sha256sum -c ../../dist/SHA256SUMS
	$(VENV)/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible --of JSON \
		-o dist/coopoc.cdx.json $(VENV)/bin/python
	.ci/hashes $(VENV)/bin/python dist/requirements.txt

benchmark: $(VENV)/.ready-dev
	OMP_NUM_THREADS=1 $(VENV)/bin/python benchmarks/run.py --gate

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "coopoc needs Python 3.11 or later: make PYTHON=python3.11")'
	@test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV) || \
		{ rm -rf $(VENV); echo "No venv module: apt-get install python3-venv, then repeat."; exit 1; }
	@echo "Installing the pinned packages into $(VENV): some minutes the first time." >&2
	$(PIP) pip
	$(PIP) setuptools wheel torch
	$(PIP) --no-build-isolation --editable '.[learned]'
	@echo 'import os, sys; "PYTHONPATH" in os.environ or sys.meta_path.sort(key=lambda f: "editable___coopoc" not in getattr(f, "__module__", ""))' > \
		"$$($(VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/coopoc-first.pth"
	@touch $(READY)

$(VENV)/.ready-dev: $(READY)
	@echo "Installing the tools of the tests." >&2
	$(PIP) --no-build-isolation --editable '.[dev,sumo,nmea,ros,flower,export]'
	@touch $@

$(VENV)/.ready-fuzz: $(VENV)/.ready-dev
	$(PIP) --no-build-isolation --editable '.[fuzz]'
	@touch $@

$(VENV)/.ready-docs: $(READY)
	@echo "Installing the tools of the site." >&2
	$(PIP) --no-build-isolation --editable '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV)
