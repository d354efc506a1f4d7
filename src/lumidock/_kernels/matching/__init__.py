"""Hot loops of acquisition."""
