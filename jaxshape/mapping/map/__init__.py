"""The map of one object: keyframes, fused and realigned with the shape that explains them."""
