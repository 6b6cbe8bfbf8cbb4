# Five words for daily work, in a virtual environment of Python 3.11 or later; `make setup` once.
DATA = ../shared/data
TESTS = -m quick

.PHONY: setup test lint docs bench

setup:
	pip install -c constraints.txt -e '.[dev,docs]' -e bench pre-commit
	pre-commit install

# The quick tests; `make test TESTS=tests` runs all of them, `make test TESTS=tests/engine/flow/test_flow.py` one file.
test:
	pytest $(TESTS) -n 2 --dist loadfile

lint:
	ruff check
	ruff format --check
	mypy
	lint-imports --no-cache

# The pages and the diagram that are written from the code, then the site, in site/.
docs:
	python docs/settings_page.py
	python docs/api_page.py
	python docs/camera_programs.py
	python docs/method_picture.py
	NO_MKDOCS_2_WARNING=1 mkdocs build --strict --quiet

# Every table of BENCHMARK.md, from phantoms and the real data in DATA: hours.
bench:
	python -m scopemap_bench.scripts.record --all --data $(DATA)
