"""Hot loops of the track filter."""
