"""Readers of mesh files: all surfaces of a file, or a refusal that says which feature is missing.

No reader ever gives a part for the whole.
"""

from collections.abc import Callable

from jaxshape.data.formats.gltf import read_gltf
from jaxshape.data.formats.obj import read_obj
from jaxshape.data.formats.off import read_off
from jaxshape.data.formats.parts import Part
from jaxshape.data.formats.ply import read_ply
from jaxshape.data.formats.stl import read_stl


def read_parts(suffix: str, content: bytes, read_relative: Callable[[str], bytes]) -> list[Part]:
    """The parts of a mesh file.

    Args:
        suffix: Suffix of its name, with the dot, in lower case.
        content: Content of the file.
        read_relative: Reads a file by its path relative to this one.

    Raises:
        Unreadable: The file is damaged.
        NotSupported: It uses a feature that is not read.
        TooManyFaces: There are too many triangles.
    """
    if suffix in (".gltf", ".glb"):
        return read_gltf(content, read_relative)
    readers = {".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl}
    return readers[suffix](content)
