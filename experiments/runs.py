"""Common code of scripts that go over many objects: choose objects, and reuse earlier runs."""

import json
from pathlib import Path
from typing import Any

import numpy as np


def spread(available: int, count: int) -> list[int]:
    """Indices of `count` objects, spread over all available ones; all if there are not more."""
    return np.linspace(0, available - 1, min(count, available)).round().astype(int).tolist()


def earlier(path: Path, settings: dict[str, Any], rows: str) -> dict[str, Any]:
    """The rows that a run with the same settings has written under this name, or none."""
    content = json.loads(path.read_text()) if path.is_file() else {}
    return content[rows] if content.get("settings") == settings else {}
