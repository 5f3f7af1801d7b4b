"""The error that all readers of recordings raise."""


class SequenceError(ValueError):
    """A sequence on disk does not match its layout; the message names the file and a remedy."""
