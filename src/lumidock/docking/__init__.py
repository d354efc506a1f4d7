"""The closed loop: a vehicle that steers itself into the dock by the fixes of a method, and what comes of it."""
