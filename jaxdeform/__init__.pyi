"""jaxdeform: differentiable mesh deformation in JAX, every part with its own rigidity."""

from ._apps.compilation_cache import enable_compilation_cache
from ._baselines.arap import arap, rc_arap
from ._baselines.cages import mean_value_coordinates
from ._baselines.laplacian_editing import (
    LaplacianEditor,
    laplacian_editing,
    laplacian_editor,
)
from ._baselines.skeletons import Skeleton, load_skeleton
from ._baselines.skinning import (
    dual_quaternion_skinning,
    linear_blend_skinning,
    rigid_transforms,
)
from ._baselines.skinning_weights import (
    bounded_biharmonic_weights,
    inverse_distance_weights,
    rigid_weights,
)
from ._baselines.sr_arap import sr_arap
from ._deformation.adjoint import Implicit, Unrolled
from ._deformation.alternating import Alternating
from ._deformation.batch import deform_batch, deform_in_chunks
from ._deformation.coarse import CoarseProblem, coarsen
from ._deformation.descent import Adjoint, Solver
from ._deformation.local_step import (
    LBFGS,
    AffineFit,
    GradientDescent,
    LocalStep,
    Newton,
    RotationFit,
)
from ._deformation.minimality import is_minimum
from ._deformation.path import deform_path
from ._deformation.problem import Problem, precompute, rigidity_from_material
from ._deformation.quasi_newton import QuasiNewton
from ._deformation.solve import Solution, deform, energy
from ._deformation.stack import stack_problems
from ._errors import InputError
from ._estimation.cell_sizes import RingsEstimate, estimate_rings
from ._estimation.discrepancy import Discrepancy
from ._estimation.estimate import Estimate
from ._estimation.field import FieldEstimate, estimate_rigidity_field
from ._estimation.found_handles import find_handle_groups, find_handles
from ._estimation.parts import estimate_rigidity
from ._estimation.rigid_groups import RigidGroup
from ._estimation.segments import segment_rigidity
from ._estimation.thesis import ThesisEstimate, estimate_rigidity_thesis
from ._estimation.verdict import Verdict
from ._handles.files import HandleFile, load_handles
from ._handles.rigid import rigid_targets
from ._handles.targets import bend, rotate, translate, twist
from ._linalg.known_value import with_derivative_of
from ._mesh import select, shapes
from ._mesh.cells import Cells, rings, spokes
from ._mesh.files import load_mesh, load_rigidity, save_mesh
from ._mesh.geodesics import geodesic_distances
from ._mesh.inspection import Inspection, inspect, repair
from ._mesh.laplacian import cotangent_weights
from ._mesh.mesh import Mesh
from ._mesh.selection import Selection
from ._mesh.submesh import Submesh, submesh
from ._plotting.animate import animate
from ._plotting.render import render, render_grid
from ._plotting.show import Turnable, show
from ._result import Result

__version__: str

__all__ = [
    "LBFGS",
    "Adjoint",
    "AffineFit",
    "Alternating",
    "Cells",
    "CoarseProblem",
    "Discrepancy",
    "Estimate",
    "FieldEstimate",
    "GradientDescent",
    "HandleFile",
    "Implicit",
    "InputError",
    "Inspection",
    "LaplacianEditor",
    "LocalStep",
    "Mesh",
    "Newton",
    "Problem",
    "QuasiNewton",
    "Result",
    "RigidGroup",
    "RingsEstimate",
    "RotationFit",
    "Selection",
    "Skeleton",
    "Solution",
    "Solver",
    "Submesh",
    "ThesisEstimate",
    "Turnable",
    "Unrolled",
    "Verdict",
    "animate",
    "arap",
    "bend",
    "bounded_biharmonic_weights",
    "coarsen",
    "cotangent_weights",
    "deform",
    "deform_batch",
    "deform_in_chunks",
    "deform_path",
    "dual_quaternion_skinning",
    "enable_compilation_cache",
    "energy",
    "estimate_rigidity",
    "estimate_rigidity_field",
    "estimate_rigidity_thesis",
    "estimate_rings",
    "find_handle_groups",
    "find_handles",
    "geodesic_distances",
    "inspect",
    "inverse_distance_weights",
    "is_minimum",
    "laplacian_editing",
    "laplacian_editor",
    "linear_blend_skinning",
    "load_handles",
    "load_mesh",
    "load_rigidity",
    "load_skeleton",
    "mean_value_coordinates",
    "precompute",
    "rc_arap",
    "render",
    "render_grid",
    "repair",
    "rigid_targets",
    "rigid_transforms",
    "rigid_weights",
    "rigidity_from_material",
    "rings",
    "rotate",
    "save_mesh",
    "segment_rigidity",
    "select",
    "shapes",
    "show",
    "spokes",
    "sr_arap",
    "stack_problems",
    "submesh",
    "translate",
    "twist",
    "with_derivative_of",
]
