"""The maps of objects: keyframes, fused and realigned with the shapes that explain them."""
