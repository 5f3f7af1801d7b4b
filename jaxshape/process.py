"""Settings of a process that must be made before JAX computes, or even before its import. [host]"""

import ctypes
import os
import platform
import signal
import sys
import threading
import warnings
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from jaxshape.limits import CACHE_BYTES

_M_ARENA_MAX = -8  # of mallopt, from malloc.h


def prepare_process() -> None:
    """Prepare the process of a command; to be called before JAX is imported.

    Compiled programs are kept (`keep_compiled`) and quickly made (`compile_quickly`), all threads
    share their memory (`share_memory`), and LAPACK gets one thread: the covariances of a search are
    too small to split, and waiting threads make a busy machine many times slower.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    share_memory()
    compile_quickly()
    keep_compiled()
    end_in_order()


def share_memory() -> None:
    """Let all threads of this process allocate from one arena; to be called before they start.

    Otherwise each of XLA's threads keeps the memory that it has freed for itself: a reconstruction
    then needs a sixth more. Without effect where the C library is not glibc; an arena number in
    `MALLOC_ARENA_MAX` takes precedence.
    """
    if "MALLOC_ARENA_MAX" not in os.environ:
        with suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").mallopt(_M_ARENA_MAX, 1)


class Terminated(KeyboardInterrupt):
    """The process was asked to end, by SIGTERM."""


def end_in_order() -> None:
    """Let SIGTERM end this process like Ctrl-C; a second SIGTERM ends it at once."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, frame: Any) -> NoReturn:
    del frame
    signal.signal(number, signal.SIG_DFL)
    raise Terminated


def keep_compiled() -> None:
    """Let JAX store compiled programs, so that the next process need not compile them again.

    JAX reads its settings from the environment, and existing settings take precedence:
    `JAX_ENABLE_COMPILATION_CACHE=false` turns this off, and `JAX_COMPILATION_CACHE_DIR` names
    another folder, whose size is then not bounded. If the folder cannot be written, nothing is
    stored; a stored program that cannot be read is compiled again.
    """
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = _folder()
    if folder is None:
        return
    bound_folder(folder, CACHE_BYTES)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    # JAX's default is one second, but a command also compiles dozens of small programs.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def compile_quickly() -> None:
    """Let XLA use its older generator of code on CPUs, where JAX still has it (JAX 0.10).

    The programs are as fast; compiling those of a reconstruction takes a fifth less processor time
    and 40 % less memory. `XLA_FLAGS` takes precedence.
    """
    if metadata.version("jax").startswith("0.10."):  # later versions refuse the flag
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")


def bound_folder(folder: Path, most: int) -> None:
    """Remove the least recently used files of a folder if its total size is too large.

    Args:
        folder: The folder, whose sub-folders are left alone.
        most: Largest total size, in bytes; if it is exceeded, files are removed down to three
            quarters of it.
    """
    try:
        with os.scandir(folder) as entries:
            found = [(entry.path, entry.stat()) for entry in entries if entry.is_file()]
        total = sum(status.st_size for _, status in found)
        left = total if total <= most else most * 3 // 4
        for path, status in sorted(found, key=lambda one: max(one[1].st_atime, one[1].st_mtime)):
            if total <= left:
                break
            os.unlink(path)
            total -= status.st_size
    except OSError:  # another process is removing them
        return


def spread_over_cores(batch: int) -> None:
    """Let JAX count the cores of the processor as devices; to be called before JAX is imported.

    Training spreads its batches over devices. On two cores a step then takes about half the time;
    XLA itself spreads little work over cores.

    Args:
        batch: Number of examples that the devices share; the number of devices divides it.
    """
    if "jax" in sys.modules:
        return
    cores = os.cpu_count() or 1
    devices = max(n for n in range(1, cores + 1) if batch % n == 0)
    os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(devices))


def join_processes(
    coordinator: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    patience: int = 300,
) -> None:
    """Make this process one of several that compute together; to be called before JAX computes.

    Args:
        coordinator: Address `host:port` at which process 0 listens; None to get it from a cluster
            that JAX knows, such as Slurm or Open MPI.
        processes: Number of processes; None as for the coordinator.
        process: Number of this process, from 0; None as for the coordinator.
        patience: Seconds, 1 or more, that a finished process waits for the others to end.

    Raises:
        ValueError: Only some are given, or no cluster is found.
    """
    given = {"coordinator": coordinator, "processes": processes, "process": process}
    missing = [name for name, value in given.items() if value is None]
    if 0 < len(missing) < len(given):
        raise ValueError(
            f"Without {' and '.join(missing)} the processes cannot find each other; give "
            "coordinator, processes and process, or none of them if a cluster such as Slurm sets "
            "them."
        )
    import jax

    try:
        jax.distributed.initialize(
            coordinator, processes, process, shutdown_timeout_seconds=patience
        )
    except ValueError as problem:
        if not missing:
            raise
        raise ValueError(
            "There seems to be no cluster that JAX knows, such as Slurm or Open MPI; "
            "give coordinator, processes and process by hand."
        ) from problem


class Processor(NamedTuple):
    """The processor of the machine, as reported by the system.

    Attributes:
        name: Human-readable name of the processor.
        features: Instruction sets of the processor, such as `avx2`, `avx512f` and `amx_bf16`; empty
            if the system does not report them.
    """

    name: str
    features: frozenset[str]


@cache
def processor() -> Processor:
    """The machine's processor, from /proc/cpuinfo if it exists."""
    info = Path("/proc/cpuinfo")
    first, _, _ = (info.read_text() if info.exists() else "").partition("\n\n")
    lines = (line.split(":", 1) for line in first.splitlines() if ":" in line)
    fields = {name.strip(): value.strip() for name, value in lines}
    name = fields.get("model name") or platform.processor() or platform.machine()
    return Processor(name, frozenset(fields.get("flags", "").split()))


def _folder() -> Path | None:
    """The folder for compiled programs, readable only by the user; None if it cannot be made.

    Only the user may write to it, because its content is run as machine code.
    """
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "jaxshape" / "compiled"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # a home that cannot be written, or none at all
        return None
    return folder if os.access(folder, os.W_OK) else None
