"""Hot loops of the detector."""
