"""Scripts behind the tables of BENCHMARK.md: `python -m scopemap_bench.scripts.NAME`."""
