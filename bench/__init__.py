"""Measures the figures of the documentation: `make bench` runs all benches, `python -m bench NAME` one of them."""
