"""Settings of a process that must stand before JAX is imported. [host]"""

import os
from pathlib import Path


def prepare_process() -> None:
    """Settings for the command line; to be called before JAX is imported.

    Compiled programs are kept (`keep_compiled`), and LAPACK gets one thread: the covariances of a
    search are too small to share, and waiting threads make a busy machine many times slower.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    keep_compiled()


def keep_compiled() -> None:
    """Let JAX keep what it compiles, so that the next process need not compile it again.

    JAX reads its settings from the environment; those that are set there already win, so
    `JAX_ENABLE_COMPILATION_CACHE=false` turns this off and `JAX_COMPILATION_CACHE_DIR` names
    another folder. Where the folder cannot be written, nothing is kept.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = _folder()
    if folder is None:
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    # By default, only what took a second or more; but a command also compiles dozens of small ones.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def _folder() -> Path | None:
    """The folder for compiled programs, readable by the user alone; None where there can be none.

    What it holds is run as machine code.
    """
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "jaxshape" / "compiled"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # a home that cannot be written, or none at all
        return None
    return folder if os.access(folder, os.W_OK) else None
