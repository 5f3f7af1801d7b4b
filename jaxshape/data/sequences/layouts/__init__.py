"""Layouts of recordings, a file for each kind: whether a folder is one, and what it holds."""
