"""Frames in, fixes out: a file per format."""
