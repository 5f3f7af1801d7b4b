"""Kill commands at random, give them again until they end, and compare with what was not killed.

    python tests/kills.py --kills 50            # make kills

Each of dataset, train, evaluate, bench, reconstruct and scene runs once undisturbed. Then it is
killed (SIGKILL, so that nothing can be put in order) after a random time, given again, killed
again, until so many kills are spent; then it is left to end. The results have to be the same to the
last bit, apart from times. About a minute for each kill on two cores, most of it for compiling what
was not kept.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from known_shape import known_shape
from orbit_recording import record, write_recording
from safetensors.numpy import load_file

from jaxshape.model.weights import save_prior

SIZES = "--preset autoencoder --encoder 4 8 --decoder 8 --code 10".split()
TIMES = (
    "seconds",
    "training_seconds",
    "samples_per_second",
    "compiling",
    "load",
    "command",
    "source",
)
"""Entries that may differ: times, and where things lie."""


def commands(at: Path) -> dict[str, tuple[list[str], str]]:
    """The commands by name, and the option that names their output."""
    known, frames = str(at / "known.safetensors"), at / "frames"
    made = "dataset --count 130 --frames 1 --cameras paper --resolution 8 --workers 1".split()
    data = str(at / "whole" / "dataset")
    trained = ["train", "--dataset", data, "--steps", "60", "--report-every", "5", "--batch", "2"]
    scored = "evaluate --count 24 --frames 1,2 --methods encoder,cma --iterations 3".split()
    searched = "bench --methods cma,gradient:sgd --objects 3 --frames 4".split()
    found = "--iterations 3 --keyframe-iterations 2 --min-hits 1".split()
    box = ["--box", str(frames / "box.json"), "--poses", "first"]
    return {
        "dataset": (made, "dataset"),
        "train": ([*trained, *SIZES], "train"),
        "evaluate": ([*scored, "--weights", known], "evaluate.json"),
        "bench": ([*searched, "--budget", "64", "--at-a-time", "2"], "board"),
        "reconstruct": (["reconstruct", str(frames), "--weights", known, *box, *found], "result"),
        "scene": (["scene", str(frames)], "scene"),
    }


def run(arguments: Sequence[str], output: Path, after: float | None, log: Path) -> int:
    """Run a command, killed after some seconds; its exit status."""
    argv = [sys.executable, "-m", "jaxshape", *arguments, "--output", str(output)]
    with (
        open(log, "ab") as log_file,
        subprocess.Popen(argv, stdout=log_file, stderr=log_file, start_new_session=True) as process,
    ):
        try:
            return process.wait(after)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return process.wait()


def content(path: Path) -> Any:
    """What a file holds, apart from times."""
    if path.suffix == ".json":
        return without_times(json.loads(path.read_text()))
    if path.suffix == ".jsonl":
        return [without_times(json.loads(line)) for line in path.read_text().splitlines()]
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return {name: arrays[name].tobytes() for name in arrays}
    if path.suffix == ".safetensors":
        return {name: x.tobytes() for name, x in load_file(path).items()}
    return path.read_bytes()


def without_times(entry: Any) -> Any:
    if isinstance(entry, dict):
        return {
            key: without_times(value)
            for key, value in entry.items()
            if key not in TIMES and not key.startswith("seconds_")
        }
    return [without_times(one) for one in entry] if isinstance(entry, list) else entry


def differences(ours: Path, whole: Path) -> list[str]:
    """Names of the files of two results that differ, or are in one alone."""
    if whole.is_file():
        return [] if ours.is_file() and content(ours) == content(whole) else [whole.name]
    skipped = (".html", ".png", ".jpg", ".md")  # drawn from the others, with times in them
    names = {
        str(path.relative_to(folder))
        for folder in (ours, whole)
        for path in folder.rglob("*")
        if path.is_file() and path.suffix not in skipped
    }
    return sorted(
        name
        for name in names
        if not ((ours / name).is_file() and (whole / name).is_file())
        or content(ours / name) != content(whole / name)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--kills", type=int, default=50, help="kills of all commands together")
    parser.add_argument("--only", nargs="*", help="commands to kill; all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("out/kills"))
    given = parser.parse_args()
    at, draw = given.folder.resolve(), random.Random(given.seed)
    walk = record()
    if not (at / "frames").is_dir():
        write_recording(at / "frames", walk)
    save_prior(at / "known.safetensors", known_shape(walk.chair, walk.box.size), {})
    table = commands(at)
    chosen = given.only or list(table)
    lost = []
    for number, name in enumerate(chosen):
        arguments, output = table[name]
        whole, killed = at / "whole" / output, at / "killed" / output
        began = time.monotonic()
        if run(arguments, whole, None, at / "log.txt") != 0:
            raise SystemExit(f"{name} fails undisturbed; see {at / 'log.txt'}")
        lasted = time.monotonic() - began
        kills = given.kills // len(chosen) + (number < given.kills % len(chosen))
        left, ends, wrong = kills, 0, []
        while left or not ends:  # what ended between two kills begins anew
            after = draw.uniform(0.1, 0.9) * lasted if left else None
            began = time.monotonic()
            status = run(arguments, killed, after, at / "log.txt")
            if status == -signal.SIGKILL:
                left -= 1
                continue
            ends, lasted = ends + 1, min(lasted, time.monotonic() - began)
            wrong += [f"exit status {status}"] if status else differences(killed, whole)
            shutil.rmtree(killed, ignore_errors=True) if killed.is_dir() else killed.unlink()
        lost += wrong
        said = ", ".join(wrong) or "the same result"
        print(f"{name}: {kills} kills, ended {ends} times with {said}", flush=True)
    sys.exit(bool(lost))


if __name__ == "__main__":
    main()
