"""Layouts of recordings, a file for each kind, which recognises a folder and lists its frames."""
