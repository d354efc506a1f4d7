"""What the figures of README and docs/ come from: `make bench`, or `python -m bench NAME` for one of them."""
