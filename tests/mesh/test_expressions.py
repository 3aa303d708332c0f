"""Expressions: against Python's own reading of the same text, vertex by vertex."""

import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import jaxdeform as jd

RNG = np.random.default_rng(0)
MESH = jd.Mesh(RNG.normal(size=(12, 3)).round(1), RNG.permutation(12).reshape(4, 3))
LOW, HIGH = MESH.vertices.min(axis=0), MESH.vertices.max(axis=0)


def by_python(text):
    """Return where Python says that the expression holds."""
    # Numbers of NumPy, so that a division by zero gives infinity.
    text = re.sub(r"(?<![\w.])(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", r"F('\g<0>')", text)
    out = []
    for point in MESH.vertices:
        fraction = (point - LOW) / (HIGH - LOW)
        names = dict(zip("xyzuvw", [*point, *fraction], strict=True)) | {"F": np.float64}
        with np.errstate(all="ignore"):
            out.append(bool(eval(text, {"__builtins__": {}}, names)))
    return out


numbers = st.one_of(
    st.integers(0, 9).map(str),
    st.floats(0, 5, width=16).map(repr),
    st.sampled_from([".5", "3.", "1e-3", "2E2", "1.5e+1"]),
)
leaves = numbers | st.sampled_from("xyzuvw")
sums = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", " - "]), inner).map("".join),
        inner.map("({})".format),
        inner.map("-{}".format),
        inner.map("+ {}".format),
    ),
    max_leaves=6,
)
signs = st.sampled_from(["<", " <= ", " > ", ">=", "==", " != "])
comparisons = st.one_of(
    st.tuples(sums, signs, sums).map("".join),
    st.tuples(sums, signs, sums, signs, sums).map("".join),
)
expressions = st.recursive(
    comparisons,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from([" and ", " or "]), inner).map("".join),
        inner.map("not {}".format),
        inner.map("not({})".format),
        inner.map("( {} )".format),
    ),
    max_leaves=5,
)


def read(text):
    """Return the selection, or the error."""
    try:
        return jd.select.where(MESH, text)
    except jd.InputError as error:
        return error


@settings(max_examples=400, deadline=None)
@given(expressions)
@example("y > 0.3 and not x < 0")
@example("not x < 0 or y < 0 and z < 0")
@example("0 < y <= 1 != x")
@example("1 - x - y * 2 / 3 < -z")
@example("- -x<+1")
@example("1 < 2")
def test_it_reads_as_python_does(text):
    found = read(text)
    if isinstance(found, jd.InputError):
        assert "no finite result" in str(found)  # Python goes on with infinity
        assert "/" in text
    else:
        assert found.mask.tolist() == by_python(text)


@settings(max_examples=400, deadline=None)
@given(
    st.one_of(
        st.text(max_size=40),
        st.lists(
            st.sampled_from(
                [*"xyzuvw()<>=!+-*/.&|^01 \t\n", "and", "or", "not", "1e5", "<=", "==", "²"]
            ),
            max_size=30,
        ).map("".join),
        st.tuples(expressions, st.integers(0, 60), st.characters()).map(
            lambda given: given[0][: given[1]] + given[2] + given[0][given[1] :]
        ),
    )
)
def test_whatever_is_written_it_is_read_or_refused(text):
    found = read(text)
    if isinstance(found, jd.InputError):
        assert "\n" not in str(found)
        assert len(str(found)) < 400
        (note,) = found.__notes__
        line, caret = note.split("\n")
        assert (line + caret).isprintable()
        assert len(line) < 130
        assert caret.strip() == "^"
        assert len(caret) <= len(line) + 1
    else:
        assert found.mask.tolist() == by_python(" ".join(text.split()))


WRONG = {
    "y < 0.1 an x": ("found 'an' instead of a sign, 'and', 'or' or the end, at column 9", 8),
    "y = 3": ("found '=' (write ==) instead of", 2),
    "(y < 1 & x < 2)": ("found '&' (write and) instead of ')'", 7),
    "! y < 1": ("found '!' (write not) instead of a number, a coordinate or '('", 0),
    "x**2 < 1": ("found '**' (write a product, x*x)", 1),
    "(y < 1": ("it ends where ')' should stand", 6),
    "y < 1)": ("found ')' instead of", 5),
    "": ("it ends where a number, a coordinate or '(' should stand, at column 1 of ''", 0),
    "y <": ("it ends where a number", 3),
    "y < < 1": ("found '<' instead of a number", 4),
    "and y < 1": ("found 'and' instead of a number", 0),
    "x < not y": ("found 'not' instead of a number", 4),
    "2 x < 1": ("found 'x' instead of a sign", 2),
    "height < 1": ("there is no 'height': write x, y, z, or u, v, w for their fraction", 0),
    "X < 1": ("there is no 'X'", 0),
    "y": ("a number stands here, not a comparison such as y > 0.9", 0),
    "y < 1 and x": ("a number stands here, not a comparison", 10),
    "not 3": ("a number stands here, not a comparison", 4),
    "-(y < 1) < 2": ("a comparison stands here, not a number", 1),
    "1 / (x - x) < 3": ("the division has no finite result at vertex 0", 2),
    "1 / 0 < 3": ("the division has no finite result at vertex 0, at column 3", 2),
    "y < 1e999": ("this number is too large", 4),
    "1e300 * 1e300 > y": ("this has no finite result", 6),
    "(" * 200 + "y<1" + ")" * 200: ("parentheses are nested more than 30 deep", 30),
    "__import__('os').system('ls')": ("there is no '__import__'", 0),
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_expression_is_shown_with_a_caret(text):
    message, column = WRONG[text]
    with pytest.raises(jd.InputError) as caught:
        jd.select.where(MESH, text)
    assert str(caught.value).startswith("expression: ")
    assert message in str(caught.value)
    line, caret = caught.value.__notes__[0].split("\n")
    assert line.startswith(f"    {text[:60]}".rstrip())
    assert caret == " " * (4 + column) + "^"


def test_the_caret_of_a_long_expression_stands_in_an_excerpt():
    text = "x < 1 or " * 500 + "q < 1" + " or x < 1" * 500
    with pytest.raises(jd.InputError, match="column 4501 of") as caught:
        jd.select.where(MESH, text)
    line, caret = caught.value.__notes__[0].split("\n")
    assert line[caret.index("^")] == "q"
    assert len(line) < 130


def test_much_of_anything_is_read_without_recursion():
    for text in (
        "not " * 9_998 + "x < 0",
        "x < " + "-" * 9_998 + "0",
        "x" + " + 0" * 9_998 + " < 0",
        "x < 0" + " or x < 0" * 999,
        "(" * 30 + "x < 0" + ")" * 30,
    ):
        assert jd.select.where(MESH, text).mask.tolist() == (MESH.vertices[:, 0] < 0).tolist()


def test_fractions_are_of_the_box_of_the_vertices_that_have_faces():
    far = jd.Mesh(np.concatenate([MESH.vertices, [[1e6, 0, 0]]]), MESH.faces)
    assert list(jd.select.where(far, "u <= 0.5")) == list(jd.select.where(MESH, "u <= 0.5"))
    assert len(jd.select.where(MESH, "0 <= u <= 1 and 0 <= v <= 1 and 0 <= w <= 1")) == 12
    with pytest.raises(jd.InputError, match="w is no fraction, because z is 0 everywhere"):
        jd.select.where(jd.shapes.square(), "w < 0.5")
