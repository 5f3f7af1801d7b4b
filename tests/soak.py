"""Rebuild many recordings and read many meshes: nothing grows, nothing is left open or lost.

    python tests/soak.py --recordings 200 --meshes 10000        # make soak

Recordings are short walks around procedural chairs. One process rebuilds them all, one after
another, and says how its memory and its open files grow. Then each is rebuilt by a process of its
own, some at the same time, and has to give the same result to the last bit. Meshes are small files
of four formats, one in a hundred of them damaged; all are listed, checked and built by `jaxshape
dataset`.
"""

import argparse
import contextlib
import ctypes
import gc
import io
import os
import resource
import shutil
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from kills import differences, run
from orbit_recording import record, write_recording

from jaxshape.cli import main as command

WARM = 20
"""Recordings after which all programs are compiled and memory has reached its height."""

FEW = "--min-hits 1 --poses first".split()
SMALL = "--frames 1 --cameras paper --resolution 8 --workers 2".split()
FORMATS = ("obj", "ply", "off", "glb")
DAMAGED = 100
"""One mesh in so many is cut in its middle."""


class Use(NamedTuple):
    """What a process holds: megabytes of memory, and open files."""

    memory: float
    files: int


def use() -> Use:
    """What this process holds once freed memory is given back to the system (on glibc).

    Without that the allocator keeps fragments, which grow for a while and say nothing of leaks.
    """
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Use(pages * resource.getpagesize() / 1e6, len(os.listdir("/proc/self/fd")))


# ------------------------------------------------------------------ recordings


def recordings(folder: Path, count: int) -> Iterator[Path]:
    """Folders of recordings, made where they are missing."""
    for seed in range(count):
        frames = folder / f"frames-{seed}"
        if not (frames / "box.json").exists():  # which is written last
            shutil.rmtree(frames, ignore_errors=True)
            write_recording(frames, record(seed=seed))
        yield frames


def arguments(frames: Path) -> list[str]:
    return ["reconstruct", str(frames), "--box", str(frames / "box.json"), *FEW]


def in_one_process(folder: Path, made: list[Path]) -> tuple[list[Use], list[str]]:
    """Rebuild all recordings here; what this process holds after each, and what went wrong."""
    held, wrong = [], []
    for i, frames in enumerate(made):
        sys.argv = ["jaxshape", *arguments(frames), "--output", str(folder / f"one-{i}")]
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said):
                command()
        except SystemExit as ended:
            if ended.code not in (0, 3):  # 3: a result, in doubt
                wrong.append(f"recording {i}: exit status {ended.code}")
        held.append(use())
    return held, wrong


def in_many_processes(folder: Path, made: list[Path], together: int) -> list[str]:
    """Rebuild each recording in a process of its own; what differs from those of one process."""

    def rebuilt(i: int) -> list[str]:
        output, log = folder / f"many-{i}", folder / f"many-{i}.txt"
        status = run(arguments(made[i]), output, None, log)
        if status not in (0, 3):
            return [f"recording {i}: exit status {status}, see {log}"]
        return [f"recording {i}: {name}" for name in differences(output, folder / f"one-{i}")]

    with ThreadPoolExecutor(together) as pool:
        return [one for some in pool.map(rebuilt, range(len(made))) for one in some]


def growth(held: list[Use]) -> tuple[float, int]:
    """Megabytes that each recording adds, by a line through the warm ones, and files left open."""
    warm = held[min(WARM, len(held) // 2) :]
    slope = np.polyfit(np.arange(len(warm)), [one.memory for one in warm], 1)[0]
    return float(slope), warm[-1].files - warm[0].files


def soak_recordings(folder: Path, count: int, together: int, allowed: float) -> bool:
    """Rebuild recordings in one process and in many; whether all is well."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in [*folder.glob("one-*"), *folder.glob("many-*")]:
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    made = list(recordings(folder, count))
    began = time.monotonic()
    held, wrong = in_one_process(folder, made)
    (slope, files), alone = growth(held), time.monotonic() - began
    print(
        f"{count} recordings in one process: {alone / count:.1f} s each, {held[-1].memory:.0f} MB "
        f"at the end, {slope:+.2f} MB for each, {files:+d} open files",
        flush=True,
    )
    began = time.monotonic()
    wrong += in_many_processes(folder, made, together)
    print(
        f"{count} recordings in {count} processes, {together} at the same time: "
        f"{(time.monotonic() - began) / count:.1f} s each; "
        + (", ".join(wrong) or "the same results to the last bit"),
        flush=True,
    )
    return slope <= allowed and files <= 0 and not wrong


# ------------------------------------------------------------------ meshes


def write_meshes(folder: Path, count: int) -> int:
    """Stools of many proportions, four formats in turn; the number of damaged ones."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        path = folder / f"stool-{i:05d}.{FORMATS[i % len(FORMATS)]}"
        if path.exists():
            continue
        rng = np.random.default_rng(i)
        width, height, depth = rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.6)
        parts = [trimesh.creation.box((width, 0.05, depth))]
        for x in (-1, 1):
            for z in (-1, 1):
                leg = trimesh.creation.box((0.04, height, 0.04))
                leg.apply_translation([x * (width / 2 - 0.02), -height / 2, z * (depth / 2 - 0.02)])
                parts.append(leg)
        data = trimesh.util.concatenate(parts).export(file_type=path.suffix[1:])
        data = data.encode() if isinstance(data, str) else data
        path.write_bytes(data[: len(data) // 2] if i % DAMAGED == 0 else data)
    return -(-count // DAMAGED)


def soak_meshes(folder: Path, count: int) -> bool:
    """List, check and build a folder of meshes; whether each is in the dataset or named."""
    from jaxshape.data.dataset import open_dataset

    damaged, output = write_meshes(folder / "meshes", count), folder / "dataset"
    shutil.rmtree(output, ignore_errors=True)
    began = time.monotonic()
    building = ["dataset", "--meshes", str(folder / "meshes"), *SMALL]
    status = run(building, output, None, folder / "dataset.txt")
    lasted = time.monotonic() - began
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
    built = len(open_dataset(output).names) if status == 0 else 0
    print(
        f"{count} meshes, {damaged} of them damaged: {built} built in {lasted:.0f} s, exit status "
        f"{status}, {peak:.0f} MB in the largest process",
        flush=True,
    )
    return built == count - damaged


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--together", type=int, default=2, help="processes at the same time")
    parser.add_argument("--megabytes", type=float, default=0.5, help="allowed for each recording")
    parser.add_argument("--meshes", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, default=Path("out/soak"))
    given = parser.parse_args()
    folder = given.folder.resolve()
    well = []
    if given.recordings:
        well.append(
            soak_recordings(
                folder / "recordings", given.recordings, given.together, given.megabytes
            )
        )
    if given.meshes:
        well.append(soak_meshes(folder / "meshes", given.meshes))
    sys.exit(not all(well))


if __name__ == "__main__":
    main()
