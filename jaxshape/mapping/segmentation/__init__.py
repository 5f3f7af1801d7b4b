"""Segmentation of the object in a depth frame: planes, clusters, and the choice among them."""
