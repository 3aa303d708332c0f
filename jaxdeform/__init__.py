"""jaxdeform: differentiable mesh deformation in JAX, every part with its own rigidity."""

from jaxdeform import shapes
from jaxdeform.deformation import (
    Alternating,
    Implicit,
    Problem,
    QuasiNewton,
    Result,
    Solution,
    Unrolled,
    deform,
    energy,
    material,
    precompute,
)
from jaxdeform.laplacian import cotangent_weights
from jaxdeform.local_step import LBFGS, AffineFit, GradientDescent, Newton, RotationFit
from jaxdeform.mesh import (
    InputError,
    Inspection,
    Mesh,
    inspect,
    load_mesh,
    load_rigidity,
    repair,
    save_mesh,
)
from jaxdeform.neighborhood import Cells, rings, spokes
from jaxdeform.shapes import bend, rotate, translate, twist
from jaxdeform.submesh import Part, cut

__all__ = [
    "LBFGS",
    "AffineFit",
    "Alternating",
    "Cells",
    "GradientDescent",
    "Implicit",
    "InputError",
    "Inspection",
    "Mesh",
    "Newton",
    "Part",
    "Problem",
    "QuasiNewton",
    "Result",
    "RotationFit",
    "Solution",
    "Unrolled",
    "bend",
    "cotangent_weights",
    "cut",
    "deform",
    "energy",
    "inspect",
    "load_mesh",
    "load_rigidity",
    "material",
    "precompute",
    "repair",
    "rings",
    "rotate",
    "save_mesh",
    "shapes",
    "spokes",
    "translate",
    "twist",
]
