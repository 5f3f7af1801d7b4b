import shutil

import pytest
from result_folder import write_folder


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
