"""Hot loops of the simulator: rays, surfaces and light on solids."""
