"""Changes of valid inputs, the same for the same seed: fuzzing that needs nothing else."""

import re

import numpy as np

NUMBERS = (b"0", b"-1", b"1e400", b"1e-400", b"nan", b"Infinity", b"99999999999999999999", b'"1"',
           b"true", b"null", b"[]", b"{}", b"[" * 200, b"\\u0000", b"1e30", b"65536")  # fmt: skip
"""What is put in the place of a number in a text."""

BYTES = (b"\x00", b"\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\xff", b"\x00\x00\x00\x80")
"""What is put in the place of bytes: the sizes at which readers go wrong."""


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """A valid input with one to three changes."""
    for _ in range(rng.integers(1, 4)):
        content = CHANGES[rng.integers(len(CHANGES))](content, rng)
    return content


def _place(content: bytes, rng: np.random.Generator) -> int:
    """Anywhere, but as often near the beginning, where headers are."""
    return int(rng.integers(0, 1 + min(len(content), 64 if rng.random() < 0.5 else 10**9)))


def _flipped(content: bytes, rng: np.random.Generator) -> bytes:
    at = _place(content, rng)
    return content[:at] + bytes([rng.integers(256)]) + content[at + 1 :]


def _cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: _place(content, rng)]


def _without(content: bytes, rng: np.random.Generator) -> bytes:
    at = _place(content, rng)
    return content[:at] + content[at + int(rng.integers(1, 30)) :]


def _doubled(content: bytes, rng: np.random.Generator) -> bytes:
    at, count = _place(content, rng), int(rng.integers(1, 60))
    return content[: at + count] + content[at:]


def _with_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    at, put = _place(content, rng), BYTES[rng.integers(len(BYTES))]
    return content[:at] + put + content[at + len(put) :]


def _with_number(content: bytes, rng: np.random.Generator) -> bytes:
    found = list(re.finditer(rb"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", content[1:5000]))
    if not found:
        return _flipped(content, rng)
    one, put = found[rng.integers(len(found))], NUMBERS[rng.integers(len(NUMBERS))]
    return content[: 1 + one.start()] + put + content[1 + one.end() :]


CHANGES = (_flipped, _cut, _without, _doubled, _with_bytes, _with_number, _with_number)
