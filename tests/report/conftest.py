import shutil

import numpy as np
import pytest
from result_folder import write_folder

from jaxshape.results.surface import read_ply, write_mesh


@pytest.fixture(scope="package")
def made(tmp_path_factory):
    """A result folder, not to be changed."""
    folder = tmp_path_factory.mktemp("made") / "result"
    write_folder(folder)
    return folder


@pytest.fixture
def folder(made, tmp_path):
    """A copy to spoil."""
    return shutil.copytree(made, tmp_path / "result")


@pytest.fixture
def painted(folder):
    """A copy whose mesh has colours, green, and is measured in its upper half."""
    mesh = read_ply(folder / "mesh.ply").mesh
    measured = np.asarray(mesh.vertices[:, 1] > mesh.vertices[:, 1].mean())
    green = np.full((len(mesh.vertices), 3), (20, 160, 60), np.uint8)
    write_mesh(mesh, folder / "mesh.ply", measured=measured, color=green)
    return folder
