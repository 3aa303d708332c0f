"""jaxdeform: differentiable mesh deformation in JAX, every part with its own rigidity."""

from jaxdeform._apps.compilation_cache import enable_compilation_cache
from jaxdeform._baselines.arap import arap, rc_arap
from jaxdeform._baselines.cages import mean_value_coordinates
from jaxdeform._baselines.laplacian_editing import (
    LaplacianEditor,
    laplacian_editing,
    laplacian_editor,
)
from jaxdeform._baselines.skeletons import Skeleton, load_skeleton
from jaxdeform._baselines.skinning import (
    dual_quaternion_skinning,
    linear_blend_skinning,
    rigid_transforms,
)
from jaxdeform._baselines.skinning_weights import (
    bounded_biharmonic_weights,
    inverse_distance_weights,
    rigid_weights,
)
from jaxdeform._baselines.sr_arap import sr_arap
from jaxdeform._deformation.adjoint import Implicit, Unrolled
from jaxdeform._deformation.alternating import Alternating
from jaxdeform._deformation.batch import deform_batch, deform_in_chunks
from jaxdeform._deformation.coarse import CoarseProblem, coarsen
from jaxdeform._deformation.descent import Adjoint, Solver
from jaxdeform._deformation.local_step import (
    LBFGS,
    AffineFit,
    GradientDescent,
    LocalStep,
    Newton,
    RotationFit,
)
from jaxdeform._deformation.minimality import is_minimum
from jaxdeform._deformation.path import deform_path
from jaxdeform._deformation.problem import Problem, precompute, rigidity_from_material
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._deformation.solve import Solution, deform, energy
from jaxdeform._deformation.stack import stack_problems
from jaxdeform._errors import InputError
from jaxdeform._estimation.discrepancy import Discrepancy
from jaxdeform._estimation.field import FieldEstimate, estimate_rigidity_field
from jaxdeform._estimation.parts import Estimate, estimate_rigidity
from jaxdeform._estimation.rigid_groups import RigidGroup, find_handle_groups, find_handles
from jaxdeform._estimation.segments import segment_rigidity
from jaxdeform._estimation.thesis import ThesisEstimate, estimate_rigidity_thesis
from jaxdeform._estimation.verdict import Verdict
from jaxdeform._handles.files import HandleFile, load_handles
from jaxdeform._handles.rigid import rigid_targets
from jaxdeform._handles.targets import bend, rotate, translate, twist
from jaxdeform._mesh import select, shapes
from jaxdeform._mesh.cells import Cells, rings, spokes
from jaxdeform._mesh.files import load_mesh, load_rigidity, save_mesh
from jaxdeform._mesh.geodesics import geodesic_distances
from jaxdeform._mesh.inspection import Inspection, inspect, repair
from jaxdeform._mesh.laplacian import cotangent_weights
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.selection import Selection
from jaxdeform._mesh.submesh import Submesh, submesh
from jaxdeform._plotting.animate import animate
from jaxdeform._plotting.render import render, render_grid
from jaxdeform._plotting.show import Turnable, show
from jaxdeform._result import Result

__version__ = "0.1.0"  # pyproject.toml reads it from here

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
]
