"""Small glTF files, built number by number."""

import base64
import json

import numpy as np

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
WIDTHS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
"""The origin and one corner on each axis."""

FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint16)


class Gltf:
    """A header that grows, with all numbers in one buffer."""

    def __init__(self, **entries):
        self.header = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], **entries}
        self.data = b""

    def view(self, content):
        self.data += bytes(-len(self.data) % 4)
        about = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.data += content
        self.header["bufferViews"].append(about)
        return len(self.header["bufferViews"]) - 1

    def array(self, values, **entries):
        """Add an accessor; returns its number."""
        values = np.asarray(values)
        rows = values.reshape(len(values), -1)
        about = {
            "bufferView": self.view(rows.tobytes()),
            "componentType": COMPONENTS[values.dtype.str[1:]],
            "type": WIDTHS[rows.shape[1]],
            "count": len(rows),
        }
        self.header["accessors"].append(about | entries)
        return len(self.header["accessors"]) - 1

    def origins(self, count):
        """Add an accessor that states a number of points at 0 in a few bytes; returns its
        number."""
        nothing = {"bufferView": self.view(bytes(4)), "componentType": 5125}
        about = {"componentType": 5126, "type": "VEC3", "count": count}
        sparse = {"count": 0, "indices": nothing, "values": nothing}
        self.header["accessors"].append(about | {"sparse": sparse})
        return len(self.header["accessors"]) - 1

    def tetrahedron(self, **entries):
        """A primitive of `CORNERS` and `FACES`."""
        return {
            "attributes": {"POSITION": self.array(CORNERS)},
            "indices": self.array(FACES.ravel()),
        } | entries

    def content(self, uri=None):
        """The file, with its buffer inside, or in a file of that name."""
        inside = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        buffers = [{"byteLength": len(self.data), "uri": uri or inside}]
        return json.dumps(self.header | {"buffers": buffers}).encode()


def triangles(parts):
    """Corners `[f 3 3]` of all triangles, in an order that does not depend on theirs."""
    corners = np.concatenate([part.vertices[part.faces] for part in parts])
    return np.array(sorted(sorted(map(tuple, one)) for one in corners.round(5).tolist()))
