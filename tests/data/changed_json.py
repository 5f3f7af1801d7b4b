"""JSON contents that are wrong in one place."""


def changed(content, path, value):
    """A copy of a JSON content with another entry in one place."""
    if not path:
        return value
    copy = dict(content) if isinstance(content, dict) else list(content)
    copy[path[0]] = changed(copy[path[0]], path[1:], value)
    return copy
