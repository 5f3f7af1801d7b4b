"""Placement of the object, its position, orientation and size, by what the prior explains."""
