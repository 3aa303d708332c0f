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
from jaxdeform.handles import HandleFile, load_handles, rigid_targets
from jaxdeform.laplacian import cotangent_weights
from jaxdeform.laplacian_editing import LaplacianEditor, laplacian_editing, laplacian_editor
from jaxdeform.local_step import LBFGS, AffineFit, GradientDescent, Newton, RotationFit
from jaxdeform.mesh import (
    InputError,
    Inspection,
    Mesh,
    check_output,
    inspect,
    load_mesh,
    load_rigidity,
    repair,
    save_mesh,
)
from jaxdeform.neighborhood import Cells, rings, spokes
from jaxdeform.pictures import picture
from jaxdeform.shapes import bend, rotate, translate, twist
from jaxdeform.skinning import (
    Skeleton,
    bounded_biharmonic_weights,
    dual_quaternion_skinning,
    geodesic_distances,
    inverse_distance_weights,
    linear_blend_skinning,
    load_skeleton,
    mean_value_coordinates,
    rigid_transforms,
    rigid_weights,
)
from jaxdeform.submesh import Part, cut

__all__ = [
    "LBFGS",
    "AffineFit",
    "Alternating",
    "Cells",
    "GradientDescent",
    "HandleFile",
    "Implicit",
    "InputError",
    "Inspection",
    "LaplacianEditor",
    "Mesh",
    "Newton",
    "Part",
    "Problem",
    "QuasiNewton",
    "Result",
    "RotationFit",
    "Skeleton",
    "Solution",
    "Unrolled",
    "bend",
    "bounded_biharmonic_weights",
    "check_output",
    "cotangent_weights",
    "cut",
    "deform",
    "dual_quaternion_skinning",
    "energy",
    "geodesic_distances",
    "inspect",
    "inverse_distance_weights",
    "laplacian_editing",
    "laplacian_editor",
    "linear_blend_skinning",
    "load_handles",
    "load_mesh",
    "load_rigidity",
    "load_skeleton",
    "material",
    "mean_value_coordinates",
    "picture",
    "precompute",
    "repair",
    "rigid_targets",
    "rigid_transforms",
    "rigid_weights",
    "rings",
    "rotate",
    "save_mesh",
    "shapes",
    "spokes",
    "translate",
    "twist",
]
