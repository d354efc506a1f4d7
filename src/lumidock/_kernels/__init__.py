"""The hot loops: plain arrays in, plain arrays out, compiled by numba."""
