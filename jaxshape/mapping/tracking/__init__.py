"""The pose of a frame by registration with oriented points, and what a keyframe keeps of it."""
