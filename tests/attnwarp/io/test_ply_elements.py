"""Elements of PLY files, held to plyfile's reading of what plyfile wrote."""

import io

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from attnwarp.io.ply_elements import SIZE, TYPES, PlyError, parse_ply, write_vertices

pytestmark = pytest.mark.filterwarnings("ignore:loadtxt")  # plyfile's, of an element without rows

ENCODINGS = {"ascii": (True, "="), "little": (False, "<"), "big": (False, ">")}


def polygons(sizes, rng):
    faces = np.empty(len(sizes), [("vertex_indices", "O"), ("red", "u1"), ("weights", "O")])
    for k, size in enumerate(sizes):
        faces[k] = (
            rng.integers(-9, 99, size).astype("i4"),
            rng.integers(256),
            rng.normal(size=k % 3).astype("f4"),
        )
    types = {"vertex_indices": "i4", "weights": "f4"}
    sizes = {"vertex_indices": "u1", "weights": "i2"}
    return PlyElement.describe(faces, "face", val_types=types, len_types=sizes)


def written(encoding, sizes, comments=()):
    """A PLY of a vertex element with every type, a face element with two lists, and an empty one;
    what plyfile reads of it.
    """
    rng = np.random.default_rng(0)
    kinds = sorted(set(TYPES.values()))
    vertices = np.zeros(7, [(f"p_{kind}", kind) for kind in kinds])
    for kind in kinds:
        low, high = (-1e3, 1e3) if kind[0] == "f" else (np.iinfo(kind).min, np.iinfo(kind).max)
        vertices[f"p_{kind}"] = rng.uniform(low, high, 7).astype(kind)
        if kind[0] in "iu":
            vertices[f"p_{kind}"][:2] = low, high
    empty = PlyElement.describe(np.zeros(0, [("a", "f4")]), "edge")
    text, order = ENCODINGS[encoding]
    elements = [PlyElement.describe(vertices, "vertex"), empty, polygons(sizes, rng)]
    stream = io.BytesIO()
    PlyData(elements, text=text, byte_order=order, comments=list(comments)).write(stream)
    return stream.getvalue(), PlyData.read(io.BytesIO(stream.getvalue()))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    "sizes", [[3] * 9, [3, 4, 3, 3, 5, 3, 0, 4], [], [3] * 200 + [4, 3] * 60 + [5] * 99]
)
def test_every_type_and_list_is_read_as_plyfile_reads_it(encoding, sizes):
    data, theirs = written(encoding, sizes, ["attnwarp kind 2d", "made by hand"])
    elements, comments = parse_ply(data)
    assert comments == theirs.comments and list(elements) == [e.name for e in theirs.elements]
    for element in theirs.elements:
        mine = elements[element.name]
        assert mine.count == element.count
        for prop in element.properties:
            column, expected = mine.columns[prop.name], element[prop.name]
            if SIZE + prop.name in mine.columns:
                assert mine.columns[SIZE + prop.name].tolist() == [len(row) for row in expected]
                expected = np.concatenate([np.zeros(0, column.dtype), *expected])
            assert column.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
            assert np.array_equal(column, expected)
    assert set(elements["face"].scalars()) == {"red"}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_file_cut_anywhere_is_refused_and_so_is_one_with_more(encoding):
    data, _ = written(encoding, [3, 4, 3, 3, 5])
    text = encoding == "ascii"
    # Of text the last number may lose digits, which nothing tells.
    whole = data.rstrip().rindex(b" ") if text else len(data) - 1
    for size in range(0, whole, 7):
        with pytest.raises(PlyError):
            parse_ply(data[:size])
    for more in (b"1 2\n", b"0", bytes(8)):
        with pytest.raises(PlyError, match="left after the rows"):
            parse_ply(data + more)


@pytest.mark.parametrize(
    ("head", "body", "message"),
    [
        ("element a 1\nproperty uchar x", "256", "x: has values that its type cannot hold"),
        ("element a 1\nproperty int x", "1.5", "has values that its type cannot hold"),
        ("element a 2\nproperty int x", "1 2\n3", "row 0 is damaged"),
        ("element a 1\nproperty list uchar int x", "-1", "row 0 is damaged"),
        ("element a 1\nproperty list uchar int x\nproperty int y", "3 1 2", "row 0 is damaged"),
        ("element a 1\nproperty list float int x", "1 1", "damaged header: line 4"),
        ("element a 1\nproperty int x\nproperty int x", "1 1", "damaged header: line 5"),
        ("element a 1\nproperty int x\nelement a 1", "1", "damaged header: line 5"),
        ("property int x\nelement a 1", "1", "damaged header: line 3"),
        ("element a one", "", "damaged header: line 3"),
    ],
)
def test_what_is_damaged_is_named(head, body, message):
    data = f"ply\nformat ascii 1.0\n{head}\nend_header\n{body}\n".encode()
    with pytest.raises(PlyError) as caught:
        parse_ply(data)
    assert message.rpartition(": ")[2] in str(caught.value)


def test_plyfile_reads_what_is_written():
    rows = np.zeros(3, [("x", "<f8"), ("red", "u1"), ("a", "<f4")])
    rows["x"], rows["red"], rows["a"] = [1.5, -2, 1e300], [0, 7, 255], [0.1, 2, 3]
    stream = io.BytesIO()
    write_vertices(stream, rows, ["one", "two 2"])
    theirs = PlyData.read(io.BytesIO(stream.getvalue()))
    assert theirs.comments == ["one", "two 2"] and theirs.byte_order == "<"
    assert np.array_equal(theirs["vertex"].data, rows)
    assert np.array_equal(parse_ply(stream.getvalue())[0]["vertex"].columns["x"], rows["x"])
