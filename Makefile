# From a bare checkout with Python 3.10-3.13, a C compiler and make: `make demo`, `make test`, `make test-slow` (what
# `make test` leaves out), `make gate`, `make lint`, and `make test-portable`, the tests of the method and the splatter
# as a plainer processor rounds.

PYTHON ?= python3
VENV ?= .venv
# Test processes of one thread each. `worksteal` leaves the tests of a file together, so that a run which they share is
# trained once.
JOBS ?= 2

BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow test-portable gate lint docs clean

demo: $(STAMP)
	$(BIN)/python -m examples.drawn_scene

# The moving picture and the splat of docs/gallery.md, trained on the CPU.
.PHONY: turn
turn: $(STAMP)
	$(BIN)/python -m examples.drawn_scene.scene turn-output/demo --width 320 --height 240 --views 64
	CUDA_VISIBLE_DEVICES= $(BIN)/ns-train sadgs --data turn-output/demo --output-dir turn-output --timestamp run \
	  --vis tensorboard --max-num-iterations 600 --pipeline.views-per-iteration 1 --pipeline.model.sh-degree 0 \
	  --pipeline.model.strategy.max-gaussians 10000
	$(BIN)/python -m examples.turn turn-output/demo/sadgs/run --output turn-output/turn.webp --shrink 3
	$(BIN)/sadgs-export turn-output/demo/sadgs/run --output turn-output/room.ply --frame colmap

test: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist worksteal

# Tests of rare cases, and of whole commands in processes of their own, which `test` leaves out.
test-slow: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m slow

# ATEN_CPU_CAPABILITY=default keeps torch from its AVX2 and AVX-512 kernels, which round differently. A test that
# fails in only one of `test` and `test-portable` depends on the processor.
test-portable: $(STAMP)
	ATEN_CPU_CAPABILITY=default OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) tests/method tests/geometry tests/render

# On the CPU, with one thread a run (results depend on their number), and without LPIPS, whose weights are a download.
gate: $(STAMP)
	rm -rf gate-output
	$(BIN)/python -m examples.drawn_scene.scene gate-output/demo --width 80 --height 60 --views 24
	CUDA_VISIBLE_DEVICES= OMP_NUM_THREADS=1 TORCH_HOME=/dev/null $(BIN)/python -m benchmarks configs/bench/demo-gate.yaml \
	  --scenes gate-output --output gate-output/gate.jsonl --jobs-per-gpu 2 --gate configs/bench/baselines/demo-gate.json

lint: $(STAMP)
	$(BIN)/ruff check sadgs_ns benchmarks examples tests
	$(BIN)/ruff format --check sadgs_ns benchmarks examples tests
	$(BIN)/pyright --pythonpath $(BIN)/python

# The site, in `site/`. mkdocs ends with an error at every warning, such as a link to nowhere.
docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# The stamp is written last, so an interrupted installation is taken up again.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' || { \
	  echo 'sadgs_ns needs Python 3.10, 3.11, 3.12 or 3.13, and "$(PYTHON)" is not one; name one: make PYTHON=python3.11' >&2; \
	  exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[all,dev]'
	touch $@

clean:
	rm -rf $(VENV) demo-output turn-output gate-output outputs build site *.egg-info .pytest_cache .ruff_cache .hypothesis
	find sadgs_ns benchmarks examples tests -name __pycache__ -type d -prune -exec rm -rf {} +
