import numpy as np
import pytest
from orbit_recording import write_recording
from PIL import Image

from jaxshape.data.boxes import read_box
from jaxshape.data.sequences import open_sequence
from jaxshape.mapping.map.recording import follow
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt

FRAMES = 8


@pytest.fixture(scope="module")
def sequence(tmp_path_factory, walk):
    folder = write_recording(tmp_path_factory.mktemp("progress") / "frames", walk)
    black = np.zeros_like(walk.depth[0])
    Image.fromarray(black).save(folder / "frame-000003.depth.png")
    (folder / "frame-000004.depth.png").write_bytes(b"")
    return open_sequence(folder)


@pytest.fixture(scope="module")
def steps(sequence, known, mapper, tmp_path_factory):
    """The progress after each frame of a run that is not interrupted."""
    box = read_box(sequence.files[0].depth.parent / "box.json")
    start = find_start(sequence, known, Prompt(), box=box)
    return list(follow(sequence, start, mapper, known, chosen=range(FRAMES)))
