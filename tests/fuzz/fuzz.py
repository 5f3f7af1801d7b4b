"""Fuzz one reader with atheris, led by what its inputs reach.

    python tests/fuzz/fuzz.py image -max_total_time=120

Options are those of libFuzzer. It begins from the seeds of the harness and from `corpus/NAME`. An
input that breaks the reader is written to `crash-...` in the current folder; keep it in the corpus.
"""

import sys
import tempfile
import warnings
from pathlib import Path

import atheris  # pyright: ignore[reportMissingImports] - of the extra `fuzz`
import numpy as np

with atheris.instrument_imports(include=["jaxshape.reading", "jaxshape.data", "jaxshape.results"]):
    from harnesses import HARNESSES, survives


def main() -> None:
    name, *options = sys.argv[1:]
    harness, folder = HARNESSES[name], Path(tempfile.mkdtemp())
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    corpus, work = Path(__file__).parent / "corpus" / name, folder / "work"
    start = folder / "corpus"
    for one in (work, start):
        one.mkdir()
    for number, seed in enumerate(harness.seeds()):
        (start / f"seed-{number}").write_bytes(seed)
    kept = [str(corpus)] if corpus.is_dir() else []
    given = [sys.argv[0], "-max_len=20000", *options, str(start), *kept]
    atheris.Setup(given, lambda content: survives(harness, content, work) and None)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
