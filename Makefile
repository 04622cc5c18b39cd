# `make run` and `make test` set up everything they need in .venv; PYTHON=python3.12 picks another interpreter.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: run view figures film test campaign smoke docs lint types clean

run: .venv/run
	$(BIN)/qpavoid compare situation1 situation2 chasing_sphere five_spheres stall \
	  --solvers tracking,eq10-literal,eq10,qp --out out

view: .venv/view
	$(BIN)/qpavoid view panda_drag

figures: run
	$(BIN)/python docs/figures/draw.py
	cp out/five_spheres_compare_time.png out/five_spheres_qp_motion.png docs/figures/

film: .venv/dev
	$(BIN)/qpavoid render panda_ball --gif docs/figures/panda_ball.gif

test: .venv/dev
	$(BIN)/qpavoid warmup  # once, and not in each of the processes
	$(BIN)/pytest -n $$(($$(nproc) + 1)) --dist loadfile  # one more than processors: some tests wait for others

campaign: .venv/dev
	$(BIN)/pytest -n auto -m slow

smoke: .venv/dev
	$(BIN)/qpavoid bench smoke

docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev
	$(BIN)/mypy

.venv/run: pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --editable '.[plots]'
	touch $@

.venv/view: pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --editable '.[view]'
	touch $@

.venv/docs: pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --editable '.[docs]'
	touch $@

.venv/dev: pyproject.toml | .venv/bin/python
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@

.venv/bin/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 10) <= v <= (3, 14) else \
	"qpavoid needs Python 3.10 to 3.14, this is %d.%d: make PYTHON=python3.12 ..." % v)'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip

clean:
	rm -rf .venv out dist site
