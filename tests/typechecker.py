"""beartype for every function; public ones check their arguments themselves."""

import ast
from pathlib import Path

from beartype import beartype

INIT = Path(__file__).parents[1] / "jaxdeform" / "__init__.pyi"
PUBLIC = next(
    set(ast.literal_eval(node.value))
    for node in ast.parse(INIT.read_text()).body
    if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__"
)
PUBLIC |= {"bar", "cactus", "cylinder", "octopus", "square"}  # jd.shapes
PUBLIC |= {"border", "box", "component", "halfspace", "mask", "nearest", "sphere"}  # jd.select
PUBLIC |= {"where", "within"}
SETTINGS = {"Alternating", "GradientDescent", "Implicit", "LBFGS", "Newton", "QuasiNewton"}
PUBLIC |= {f"{name}.__init__" for name in {"Cells", "Mesh", "Selection", *SETTINGS}}


def check(function):
    """Return the function with its annotations checked at every call.

    Misuse of a public function must reach the function's own checks, which say what is wrong. So of
    those only what they return is checked.
    """
    if getattr(function, "__qualname__", "") in PUBLIC:
        returns = {k: v for k, v in function.__annotations__.items() if k == "return"}
        function.__annotations__ = returns
    return beartype(function)
