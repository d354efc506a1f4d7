"""The console: what the camera sees, what it is taken for and why there is no pose, as a page in a browser."""
