"""A PLY that was read is written with other positions, and all else that it held."""

import numpy as np
import pytest
from helpers import CASES, crosses, moved

import jaxdeform as jd

PLY_HEAD = """ply
format {format} 1.0
comment by hand
obj_info scanned
element vertex 4
property float x
property float y
property uchar red
property float z
property float nx
property float ny
property float nz
property float quality
element face 2
property uchar material
property list uchar int vertex_indices
property list uchar float texcoord
property float nx
property float ny
property float nz
element edge 1
property int vertex1
property int vertex2
end_header
"""
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]])


@pytest.mark.parametrize("same_lengths", [False, True])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_ply_keeps_properties_elements_and_comments(tmp_path, encoding, same_lengths):
    path = tmp_path / "m.ply"
    sign = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    faces = [[0, 1, 2], [0, 2, 3]] if same_lengths else [[0, 1, 2, 3], [0, 2, 1]]

    def record(*values):
        if not sign:
            return (" ".join(str(value) for _, value in values) + "\n").encode()
        return b"".join(np.array(value, sign + kind).tobytes() for kind, value in values)

    def body(points, normals, face_normals, position):
        out = []
        for k in range(4):
            x, y, z = ((position, value) for value in points[k].tolist())
            normal = [("f4", f"{value:.6f}") for value in normals[k]]
            out.append(record(x, y, ("u1", 7 * k), z, *normal, ("f4", 0.25)))
        for k, face in enumerate(faces):
            corners = [("u1", len(face)), *[("i4", value) for value in face]]
            normal = [("f4", f"{value:.6f}") for value in face_normals[k]]
            out.append(record(("u1", k), *corners, ("u1", 2), ("f4", 0.5), ("f4", 0.125), *normal))
        out.append(record(("i4", 2), ("i4", 3)))
        return b"".join(out)

    head = PLY_HEAD.format(format=encoding)
    ones = np.ones((4, 3))
    path.write_bytes(head.encode() + body(POINTS, ones, ones, "f4"))
    mesh = jd.load_mesh(path)
    assert mesh.vertices.tolist() == POINTS.tolist()
    for new in (moved(mesh), mesh.vertices * 2):
        jd.save_mesh(path, mesh, vertices=new)
        # Twice a float is a float; other positions become double.
        double = bool((new.astype(np.float32) != new).any())
        want = head
        for axis in "xyz" if double else "":
            want = want.replace(f"property float {axis}\n", f"property double {axis}\n")
        normals = crosses(new, *faces)
        at = [sum(n for n, face in zip(normals, faces, strict=True) if k in face) for k in range(4)]
        unit = lambda rows: [row / np.linalg.norm(row) for row in rows]  # noqa: E731
        found = path.read_bytes()
        expected = body(new, unit(at), unit(normals), "f8" if double else "f4")
        assert found[: len(want)] == want.encode()
        if sign:  # normals were rounded to six digits for the text
            spread = np.abs(np.frombuffer(found[len(want) :], "u1").astype(int)
                            - np.frombuffer(expected, "u1"))  # fmt: skip
            assert len(found) == len(want) + len(expected)
            assert (spread > 0).sum() <= 3 * 6 * 3  # the last bytes of 18 numbers
        else:
            assert found[len(want) :] == expected
        assert jd.load_mesh(path).vertices.tobytes() == new.tobytes()


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_rigidity_joins_what_a_ply_has(tmp_path, encoding):
    path = tmp_path / "m.ply"
    if encoding == "ascii":
        path.write_bytes((CASES / "37_tristrips.ply").read_bytes())
        mesh = jd.load_mesh(path)
    else:
        jd.save_mesh(path, jd.load_mesh(CASES / "24_quad.off"))
        mesh = jd.load_mesh(path)
    for values in ([0.1, 0.2, 0.3, 0.7], [1.0, 2.0, 3.0, 4.0]):  # added, then replaced
        jd.save_mesh(path, mesh, rigidity=values)
        assert jd.load_rigidity(path).tolist() == values
        mesh = jd.load_mesh(path)
        assert path.read_bytes().count(b"property double rigidity") == 1
    # It stays when only positions change.
    jd.save_mesh(path, mesh, vertices=mesh.vertices + 1)
    assert jd.load_rigidity(path).tolist() == [1.0, 2.0, 3.0, 4.0]
