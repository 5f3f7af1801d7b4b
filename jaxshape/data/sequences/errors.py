"""The error that all readers of recordings raise."""


class SequenceError(ValueError):
    """A sequence on disk is not what its layout promises; says which file, and what to do."""
