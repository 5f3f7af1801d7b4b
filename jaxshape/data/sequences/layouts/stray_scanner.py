"""Stray Scanner: recordings with the LiDAR of an iPhone or iPad."""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.cameras import Calibration, matrices_of
from jaxshape.data.sequences.documents import read_document, rows_of
from jaxshape.data.sequences.frames import Finding, SequenceError, usual_shape
from jaxshape.data.sequences.listing import (
    Contents,
    Listed,
    color_images,
    depth_images,
    files_in,
    frame_files,
    has_depth_folder,
    last_number,
    miscounted_poses,
    partners,
)
from jaxshape.data.sequences.poses import from_quaternions, known

_FILM = (1440, 1920)
"""Height and width of the film, to which the camera matrix belongs."""

MAX_COLUMNS = 100
"""Largest number of columns of the table that are read."""

_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_OWN_CAMERA = ("fx", "fy", "cx", "cy")


def fits(contents: Contents) -> bool:
    return "odometry.csv" in contents.files and has_depth_folder(contents)


def list_frames(contents: Contents) -> Listed:
    """`depth/N.png` in millimetres, `confidence/N.png`, `odometry.csv`, `camera_matrix.csv`.

    Poses are camera to world, with OpenCV's axes. Newer versions give each frame its own camera.
    The colours are in a film, `rgb.mp4`; they are used if it was unpacked to `rgb/N.png`.
    """
    depth = depth_images(contents)
    source = contents.folder / "odometry.csv"
    columns = _read_columns(source)
    row_of = {int(number): row for row, number in enumerate(columns["frame"])}
    rows = [row_of.get(last_number(name), -1) for name in depth]
    places = np.stack([columns[name] for name in "xyz"], axis=-1)
    turns = np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")], axis=-1)
    T = from_quaternions(places, turns, source)
    color = partners(depth, color_images(contents))
    maps = files_in(contents, ("confidence",), (".png",))
    confidence = partners(depth, maps)

    def read(index: int) -> Float[np.ndarray, "4 4"] | None:
        row = rows[index]
        return None if row < 0 else known(T[row], f"Pose {row} of {source}")

    times = columns["timestamp"][rows]
    rising = min(rows) >= 0 and bool((np.diff(times) > 0).all())
    return Listed(
        files=frame_files(contents, depth, color, confidence),
        depth_scale=1000.0,
        read_pose=read,
        times=times if rising else None,
        calibration=_calibration(contents, columns, rows, color),
        findings=(
            *(_without_film(contents) if not any(color) else ()),
            *miscounted_poses([row >= 0 for row in rows], len(row_of)),
            *(_without_confidence(confidence.count(None), len(depth)) if maps else ()),
        ),
    )


def _read_columns(path: Path) -> dict[str, Float[np.ndarray, " n"]]:
    """The columns of the table by their names; NaN for empty cells."""
    try:
        lines = list(csv.reader(read_document(path).splitlines()))
    except csv.Error as error:
        raise SequenceError(
            f"{path} is not a table ({error}); export the recording again."
        ) from error
    names = [name.strip() for name in lines[0][:MAX_COLUMNS]] if lines else []
    if missing := [name for name in _COLUMNS if name not in names]:
        raise SequenceError(
            f"{path} has no column {missing[0]}; expected a first line of {', '.join(_COLUMNS)}: "
            "export the recording again."
        )
    try:
        if any(len(row) > len(lines[0]) for row in lines):
            raise ValueError("a row has more cells than the first line")
        rows = [
            [float(cell) if cell.strip() else np.nan for cell in row[: len(names)]]
            for row in lines[1:]
            if row
        ]
        table = np.array([row + [np.nan] * (len(names) - len(row)) for row in rows])
        table = table.reshape(-1, len(names))
        if not len(table):
            raise ValueError("it has no rows")
        if not np.isfinite(table[:, names.index("frame")]).all():
            raise ValueError("a row has no frame")
    except ValueError as error:
        raise SequenceError(
            f"{path} is not a table of numbers ({error}); export the recording again."
        ) from error
    return dict(zip(names, table.T, strict=True))


def _calibration(
    contents: Contents, columns: dict[str, np.ndarray], rows: list[int], color: list[Path | None]
) -> Calibration | None:
    """The camera of each frame, or else the common camera; both for images of the film's size."""
    shape = usual_shape(path for path in color if path) or _FILM
    own = [columns[name][rows] for name in _OWN_CAMERA if name in columns]
    if len(own) == 4 and min(rows) >= 0 and np.isfinite(own).all():
        return Calibration(matrices_of(*own), shape, "odometry.csv, of each frame its own")
    if "camera_matrix.csv" not in contents.files:
        return None
    K = np.array(rows_of(contents.folder / "camera_matrix.csv", (3,)))
    if K.shape != (3, 3):
        raise SequenceError(
            f"{contents.folder / 'camera_matrix.csv'} holds {len(K)} lines; expected 3 of 3 "
            "numbers: export the recording again."
        )
    return Calibration(K[None], shape, "camera_matrix.csv")


def _without_confidence(missing: int, count: int) -> tuple[Finding, ...]:
    if not missing:
        return ()
    return (
        Finding(
            f"{missing} of {count} depth images have no confidence map of their number",
            "All their depths are used, guesses too; copy the folder confidence/ again.",
        ),
    )


def _without_film(contents: Contents) -> tuple[Finding, ...]:
    if "rgb.mp4" not in contents.files:
        return ()
    return (
        Finding(
            "the colours are in a film, rgb.mp4, which is not read",
            "To use them: mkdir rgb; ffmpeg -i rgb.mp4 -start_number 0 rgb/%06d.png",
        ),
    )
