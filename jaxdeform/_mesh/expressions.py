"""Expressions that choose vertices, such as ``y > 0.9 and not x < 0``: a parser of its own.

Nothing is ever given to Python's ``eval``: an expression may come from a file or a web page. Each
rule of the grammar is a method, which returns its value at all vertices:

    either     = both {"or" both}
    both       = negation {"and" negation}
    negation   = {"not"} comparison
    comparison = sum {("<" | "<=" | ">" | ">=" | "==" | "!=") sum}
    sum        = term {("+" | "-") term}
    term       = factor {("*" | "/") factor}
    factor     = {"+" | "-"} (number | coordinate | "(" either ")")
"""

import operator
import re
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Shaped

from jaxdeform._errors import InputError, a_or_an, shown
from jaxdeform._mesh.mesh import Mesh

_TOKEN = re.compile(
    r"(?P<number>([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?)|(?P<word>[^\W\d]\w*)"
    r"|(?P<sign><=|>=|==|!=|&&|\|\||\*\*|[^\w\s])|(?P<odd>\S)"
)
_COMPARE = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_SUM = {"+": operator.add, "-": operator.sub}
_TERM = {"*": operator.mul, "/": operator.truediv}
# What other languages write, and what it is here.
_INSTEAD = {
    "=": "==",
    "&": "and",
    "&&": "and",
    "|": "or",
    "||": "or",
    "!": "not",
    "~": "not",
    "^": "a product, x*x",
    "**": "a product, x*x",
}
_COORDINATES = "x, y, z, or u, v, w for their fraction (0 to 1) of the bounding box"
# Parentheses within parentheses. Python itself would fail at about a hundred.
_DEEPEST = 30
# How much of a long expression stands around the caret.
_AROUND = 60


def matching(mesh: Mesh, text: Any, name: str) -> Bool[np.ndarray, "vertices"]:
    """Return where the expression holds, or raise InputError that shows the place by a caret."""
    if not isinstance(text, str):
        raise InputError(f"{name} is {a_or_an(text)}: give a text such as 'y > 0.9 and not x < 0'")
    reader = _Reader(mesh, text, name)
    value = reader.either()
    if reader.token.text:
        reader.unexpected("a sign, 'and', 'or' or the end")
    return reader.truth(value)


class _Token(NamedTuple):
    kind: str
    text: str
    """Empty at the end of the expression."""
    at: int


class _Value(NamedTuple):
    array: Shaped[np.ndarray, "vertices"]
    """Booleans or numbers."""
    begin: _Token


class _Reader:
    """Reads an expression from left to right."""

    def __init__(self, mesh: Mesh, text: str, name: str) -> None:
        self.mesh, self.text, self.name = mesh, text, name
        found = _TOKEN.finditer(text)
        tokens = [_Token(match.lastgroup or "", match[0], match.start()) for match in found]
        self.tokens = iter([*tokens, _Token("end", "", len(text.rstrip()))])
        self.token = next(self.tokens)
        self.depth = 0

    def fail(self, token: _Token, reason: str) -> NoReturn:
        """Raise InputError. The caret is a note, which Python shows below the text."""
        place = f"at column {token.at + 1} of {shown(self.text)}"
        error = InputError(f"{self.name}: {reason}, {place}")
        first = max(0, token.at - _AROUND)
        part = self.text[first : token.at + _AROUND]
        line = "".join(c if c.isprintable() else " " for c in part)
        error.add_note(f"    {line}\n    {' ' * (token.at - first)}^")
        raise error

    def take(self, *texts: str) -> _Token | None:
        """Return the next token and go on, if it is one of these."""
        token = self.token
        if token.text not in texts:
            return None
        self.token = next(self.tokens)
        return token

    # ------------------------------------------------------------ the grammar

    def either(self) -> _Value:
        value = self.both()
        while self.take("or"):
            value = _Value(self.truth(value) | self.truth(self.both()), value.begin)
        return value

    def both(self) -> _Value:
        value = self.negation()
        while self.take("and"):
            value = _Value(self.truth(value) & self.truth(self.negation()), value.begin)
        return value

    def negation(self) -> _Value:
        begin, times = self.token, 0
        while self.take("not"):
            times += 1
        value = self.comparison()
        if not times:
            return value
        truth = self.truth(value)
        return _Value(~truth if times % 2 else truth, begin)

    def comparison(self) -> _Value:
        left = self.sum()
        true, begin = None, left.begin
        while sign := self.take(*_COMPARE):
            right = self.sum()
            holds = _COMPARE[sign.text](self.number(left), self.number(right))
            true = holds if true is None else true & holds
            left = right
        return left if true is None else _Value(true, begin)

    def sum(self) -> _Value:
        return self.chain(self.term, _SUM)

    def term(self) -> _Value:
        return self.chain(self.factor, _TERM)

    def chain(self, part: Callable[[], _Value], signs: dict[str, Callable[..., Any]]) -> _Value:
        value = part()
        while sign := self.take(*signs):
            left, right = self.number(value), self.number(part())
            with np.errstate(all="ignore"):
                result = signs[sign.text](left, right)
            value = _Value(self.finite(result, sign), value.begin)
        return value

    def factor(self) -> _Value:
        begin, negative = self.token, False
        while sign := self.take("+", "-"):
            negative ^= sign.text == "-"
        value = self.primary()
        if begin.text in ("+", "-"):
            number = self.number(value)
            value = _Value(-number if negative else number, begin)
        return value

    def primary(self) -> _Value:
        token = self.token
        if token.kind == "number":
            self.take(token.text)
            number = float(token.text)
            if number == np.inf:
                self.fail(token, "this number is too large")
            return _Value(np.full(self.mesh.n_vertices, number), token)
        if token.kind == "word" and token.text not in ("and", "or", "not"):
            self.take(token.text)
            return _Value(self.coordinate(token), token)
        if self.take("("):
            self.depth += 1
            if self.depth > _DEEPEST:
                self.fail(token, f"parentheses are nested more than {_DEEPEST} deep")
            value = self.either()
            if not self.take(")"):
                self.unexpected("')'")
            self.depth -= 1
            return _Value(value.array, token)
        self.unexpected("a number, a coordinate or '('")

    # ------------------------------------------------------------ the meaning

    def unexpected(self, wanted: str) -> NoReturn:
        token = self.token
        if not token.text:
            self.fail(token, f"it ends where {wanted} should stand")
        instead = _INSTEAD.get(token.text)
        hint = f" (write {instead})" if instead else ""
        self.fail(token, f"found {shown(token.text)}{hint} instead of {wanted}")

    def truth(self, value: _Value) -> Bool[np.ndarray, "vertices"]:
        if value.array.dtype != bool:
            self.fail(value.begin, "a number stands here, not a comparison such as y > 0.9")
        return value.array

    def number(self, value: _Value) -> Float[np.ndarray, "vertices"]:
        if value.array.dtype == bool:
            self.fail(value.begin, "a comparison stands here, not a number")
        return value.array

    def finite(self, result: np.ndarray, token: _Token) -> Float[np.ndarray, "vertices"]:
        """Return the numbers, or raise where a division by zero or an overflow left none."""
        bad = np.flatnonzero(~np.isfinite(result))
        if bad.size:
            what = "the division has" if token.text == "/" else "this has"
            self.fail(token, f"{what} no finite result at vertex {bad[0]}")
        return result

    def coordinate(self, token: _Token) -> Float[np.ndarray, "vertices"]:
        name = token.text
        if name not in tuple("xyzuvw"):
            self.fail(token, f"there is no {shown(name)}: write {_COORDINATES}")
        axis = "xyzuvw".index(name) % 3
        values = self.mesh.vertices[:, axis]
        if name in "xyz":
            return values
        box = values[self.mesh.referenced]
        low, high = box.min(), box.max()
        if low == high:
            flat = "xyz"[axis]
            self.fail(token, f"{name} is no fraction, because {flat} is {low:g} everywhere")
        with np.errstate(all="ignore"):
            return self.finite((values - low) / (high - low), token)
