"""Truth and pictures: scenarios, the light that reaches the lens, the sensor, and sequence folders made from them."""
