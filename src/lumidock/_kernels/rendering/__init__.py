"""Hot loops of the simulator: ray casting, and light on the surfaces of solids."""
