"""A user's own dock and camera: calibration files."""
