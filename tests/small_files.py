"""What tests share: small files as text."""

SUFFIXES = (".obj", ".off", ".ply", ".stl")

PLY = """ply
format ascii 1.0
comment by hand
element vertex 4
property float rigidity
property double x
property float y
property float z
property uchar red
element face 2
{flags}
property list uchar int vertex_index
element edge 1
property int a
end_header
0.5 0 0 0 255
1.5 1 0 0 255
2.5 1 1 0 255
3.5 0 1 0 255
{first}
{second}
0
"""


PLAIN_PLY = PLY.format(flags="comment", first="3 0 1 2", second="3 0 2 3")
ONE_FACET = "solid\nfacet\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendfacet\nendsolid\n"
