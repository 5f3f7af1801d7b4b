"""Placement of the object: the position, orientation and size that the prior explains best."""
