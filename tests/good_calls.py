"""A good call of each public function, and the kind of each argument."""

from pathlib import Path

import numpy as np
from helpers import CUBE
from small_meshes import small_mesh

import jaxdeform as jd

MESH = small_mesh()
HANDLES = [0, 1, 2, 3, 5]
TARGETS = MESH.vertices[HANDLES] * 1.1
CELLS = jd.rings(MESH)
PIECE = jd.submesh(MESH, [4])
N, EDGES = MESH.n_vertices, len(MESH.edges)
TWO = np.array([[0.0, 0.0, 0.1], [0.2, 0.0, 0.0]])
SKIN = {
    "vertices": MESH.vertices,
    "weights": np.full((N, 2), 0.5),
    "transforms": np.stack([np.eye(3, 4), np.eye(3, 4)]),
}
WEIGHTS = {"vertices": MESH.vertices, "controls": TWO, "distances": np.ones((N, 2))}

# Results and protocols, which a user does not make; what sets the whole process
# (apps/test_compilation_cache.py); and what takes a function (linalg/test_known_value.py).
_NOT_CALLED = (
    "Adjoint Cells CoarseProblem Discrepancy Estimate FieldEstimate HandleFile InputError "
    "Inspection LocalStep Problem Result RigidGroup Selection Skeleton Solution Solver "
    "RingsEstimate ThesisEstimate Turnable Verdict enable_compilation_cache with_derivative_of"
)
NOT_CALLED = set(_NOT_CALLED.split())
NO_ARGUMENTS = {"AffineFit", "RotationFit", "Unrolled"}
FUNCTIONS = {
    name
    for name in jd.__all__
    if callable(getattr(jd, name)) and name not in NOT_CALLED | NO_ARGUMENTS
} | {f"select.{name}" for name in jd.select.__all__}


def good_calls(folder: Path) -> dict:
    """Return a good call of each function: the function, and all its arguments by name."""
    obj, ply, tgf, sel = (folder / name for name in ("m.obj", "m.ply", "m.tgf", "h.sel"))
    jd.save_mesh(obj, MESH)
    jd.save_mesh(ply, MESH, rigidity=1.0)
    tgf.write_text("1 0 0 0\n2 0 1 0\n#\n1 2\n")
    sel.write_text("0\n" * N)
    (folder / "h.def").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    problem = jd.precompute(MESH, HANDLES)
    soft = jd.precompute(MESH, HANDLES, handle_weights=1.0)
    editor = jd.laplacian_editor(MESH, HANDLES)
    observed = {
        "problem": problem,
        "observed": MESH.vertices,
        "targets": TARGETS,
        "mask": np.ones(N, bool),
        "start": 1.0,
        "solver": jd.QuasiNewton(),
        "max_evaluations": 5,
    }
    fit = {**observed, "adjoint": jd.Implicit(), "progress": print, "throw": False}
    deformed = {
        "problem": soft,
        "rigidity": np.ones(N),
        "local": jd.Newton(),
        "solver": jd.QuasiNewton(),
        "start": MESH.vertices,
        "handle_weights": np.ones(5),
        "normals": False,
        "adjoint": jd.Implicit(),
        "throw": False,
    }
    many = {k: v for k, v in deformed.items() if k not in ("adjoint", "throw")}
    many |= {"targets": np.stack([TARGETS, TARGETS]), "rigidity": np.ones((2, N)), "memory": 10**6}
    rigid = {
        "mesh": MESH,
        "handles": HANDLES,
        "targets": TARGETS,
        "weights": np.ones(EDGES),
        "start": MESH.vertices,
    }
    edit = {
        "mesh": MESH,
        "handles": HANDLES,
        "weights": np.ones(EDGES),
        "handle_weights": np.ones(5),
        "similarity": False,
    }
    move = {"points": MESH.vertices, "degrees": 30.0}
    drawn = {
        "mesh": MESH,
        "label": "rigidity",
        "handles": HANDLES,
        "moved": [1, 5],
        "up": "y",
        "edges": True,
        "width": 64,
    }
    return {
        "Alternating": (jd.Alternating, {"steps": 3, "tolerance": 1e-3}),
        "GradientDescent": (jd.GradientDescent, {"max_steps": 3}),
        "Implicit": (jd.Implicit, {"tolerance": 1e-3, "max_steps": 3, "throw": False}),
        "LBFGS": (jd.LBFGS, {"tolerance": 1e-3, "max_steps": 3}),
        "Mesh": (
            jd.Mesh,
            {
                "vertices": MESH.vertices,
                "faces": MESH.faces,
                "source": jd.load_mesh(obj).source,
            },
        ),
        "Newton": (jd.Newton, {"max_steps": 3}),
        "QuasiNewton": (
            jd.QuasiNewton,
            {
                "tolerance": 1e-3,
                "max_steps": 3,
                "history_length": 3,
                "metric": "material",
                "leave_saddles": False,
            },
        ),
        "LaplacianEditor": (editor, {"targets": TARGETS}),
        "Submesh": (PIECE.reinsert, {"vertices": PIECE.mesh.vertices, "base": MESH.vertices}),
        "animate": (
            jd.animate,
            {
                **drawn,
                "path": folder / "m.gif",
                "poses": [MESH.vertices],
                "values": np.ones(N),
                "turn": 10.0,
                "seconds": 1.0,
            },
        ),
        "bend": (jd.bend, {**move, "along": "y", "toward": "x"}),
        "bounded_biharmonic_weights": (
            jd.bounded_biharmonic_weights,
            {"mesh": MESH, "handles": [0, 1, 2], "group": [0, 1, 0]},
        ),
        "coarsen": (jd.coarsen, {"problem": problem, "n_vertices": 5}),
        "cotangent_weights": (jd.cotangent_weights, {"mesh": MESH}),
        "deform": (
            jd.deform,
            {
                **deformed,
                "targets": TARGETS,
                "rest": MESH.vertices,
                "edge_weights": soft.cells.weights,
            },
        ),
        "deform_batch": (jd.deform_batch, {**many, "progress": print, "throw": False}),
        "deform_in_chunks": (jd.deform_in_chunks, many),
        "deform_path": (
            jd.deform_path,
            {
                **deformed,
                "targets": np.stack([MESH.vertices[HANDLES], TARGETS]),
                "progress": print,
            },
        ),
        "dual_quaternion_skinning": (jd.dual_quaternion_skinning, SKIN),
        "is_minimum": (
            jd.is_minimum,
            {
                "problem": soft,
                "targets": TARGETS,
                "rigidity": np.ones(N),
                "vertices": MESH.vertices,
                "local": jd.Newton(),
                "handle_weights": np.ones(5),
            },
        ),
        "energy": (
            jd.energy,
            {
                "problem": problem,
                "vertices": MESH.vertices,
                "transforms": np.tile(np.eye(3), (N, 1, 1)),
                "rigidity": 1.0,
            },
        ),
        "estimate_rigidity": (
            jd.estimate_rigidity,
            {**fit, "parts": np.zeros(N, int), "target_noise": 0.0, "determined_within": 10.0},
        ),
        "estimate_rigidity_field": (
            jd.estimate_rigidity_field,
            {**fit, "smoothness": 1e-4, "prior": "smooth"},
        ),
        "estimate_rigidity_thesis": (
            jd.estimate_rigidity_thesis,
            {k: v for k, v in observed.items() if k != "mask"}
            | {"step_size": 0.01, "threshold": 1e-3, "throw": False},
        ),
        "estimate_rings": (
            jd.estimate_rings,
            {
                k: v
                for k, v in fit.items()
                if k in ("problem", "observed", "targets", "mask", "progress")
            }
            | {"parts": np.zeros(N, int), "target_noise": 0.0, "most": 1},
        ),
        "find_handle_groups": (
            jd.find_handle_groups,
            {"mesh": MESH, "deformed": MESH.vertices, "tolerance": 1e-6},
        ),
        "find_handles": (
            jd.find_handles,
            {"mesh": MESH, "deformed": MESH.vertices, "tolerance": 1e-6},
        ),
        "geodesic_distances": (jd.geodesic_distances, {"mesh": MESH, "sources": [0, 1]}),
        "inspect": (jd.inspect, {"mesh": MESH}),
        "inverse_distance_weights": (jd.inverse_distance_weights, {**WEIGHTS, "power": 2.0}),
        "arap": (jd.arap, rigid),
        "rc_arap": (jd.rc_arap, {**rigid, "r": 1}),
        "show": (
            jd.show,
            {
                **{k: v for k, v in drawn.items() if k != "edges"},
                "poses": [MESH.vertices],
                "values": [np.ones(N)],
                "width": 100,
            },
        ),
        "sr_arap": (
            jd.sr_arap,
            {
                **rigid,
                **{"alpha": 0.02, "tolerance": 1e-3, "max_steps": 3, "steps": 3, "throw": False},
            },
        ),
        "laplacian_editing": (jd.laplacian_editing, {**edit, "targets": TARGETS}),
        "laplacian_editor": (jd.laplacian_editor, edit),
        "linear_blend_skinning": (jd.linear_blend_skinning, SKIN),
        "load_handles": (
            jd.load_handles,
            {"path": sel, "mesh": MESH, "motion": folder / "h.def"},
        ),
        "load_mesh": (jd.load_mesh, {"path": obj}),
        "load_rigidity": (jd.load_rigidity, {"path": ply}),
        "load_skeleton": (jd.load_skeleton, {"path": tgf}),
        "mean_value_coordinates": (
            jd.mean_value_coordinates,
            {"vertices": 0.5 * CUBE.vertices, "cage": CUBE},
        ),
        "precompute": (
            jd.precompute,
            {
                "mesh": MESH,
                "handles": HANDLES,
                "cells": CELLS,
                "handle_weights": np.ones(5),
                "dtype": np.float64,
            },
        ),
        "render": (
            jd.render,
            {
                **drawn,
                "path": folder / "m.png",
                "poses": [MESH.vertices],
                "titles": ["rest"],
                "values": [np.ones(N)],
                "columns": 1,
            },
        ),
        "render_grid": (
            jd.render_grid,
            {
                **drawn,
                "path": folder / "m.png",
                "poses": [[MESH.vertices]],
                "rows": ["r = 1"],
                "columns": ["soft"],
                "values": [[np.ones(N)]],
            },
        ),
        "repair": (jd.repair, {"mesh": MESH}),
        "rigid_targets": (
            jd.rigid_targets,
            {
                "points": TARGETS,
                "group": [0, 0, 1, 1, 1],
                "rotations": TWO,
                "translations": TWO,
                "centers": TWO,
            },
        ),
        "rigid_transforms": (
            jd.rigid_transforms,
            {"rotations": TWO, "translations": TWO, "centers": TWO},
        ),
        "rigid_weights": (jd.rigid_weights, WEIGHTS),
        "rigidity_from_material": (
            jd.rigidity_from_material,
            {"problem": problem, "constant": np.ones(N)},
        ),
        "rings": (jd.rings, {"mesh": MESH, "r": np.ones(N, int), "weights": np.ones(EDGES)}),
        "rotate": (jd.rotate, {**move, "axis": [0.0, 1.0, 0.0], "center": [0.0, 0.0, 1.0]}),
        "save_mesh": (
            jd.save_mesh,
            {"path": ply, "mesh": MESH, "vertices": MESH.vertices, "rigidity": np.ones(N)},
        ),
        "select.border": (jd.select.border, {"mesh": MESH}),
        "select.box": (jd.select.box, {"mesh": MESH, "low": [0, 0, 0], "high": [1, 1, 1]}),
        "select.component": (jd.select.component, {"mesh": MESH, "vertices": [0]}),
        "select.halfspace": (
            jd.select.halfspace,
            {"mesh": MESH, "axis": "y", "above": 0.1, "below": [0.0, 2.0, 0.0]},
        ),
        "select.mask": (jd.select.mask, {"mesh": MESH, "mask": np.ones(N, bool)}),
        "select.nearest": (
            jd.select.nearest,
            {"mesh": MESH, "point": [0.0, 1.0, 0.0], "count": 2},
        ),
        "select.sphere": (
            jd.select.sphere,
            {"mesh": MESH, "center": [0.0, 1.0, 0.0], "radius": 1.0},
        ),
        "select.where": (jd.select.where, {"mesh": MESH, "expression": "y > 0.1"}),
        "select.within": (
            jd.select.within,
            {"mesh": MESH, "sources": [0, 1], "distance": 1.0},
        ),
        "segment_rigidity": (
            jd.segment_rigidity,
            {"mesh": MESH, "field": np.arange(1.0, N + 1.0), "k": 2, "interval": np.ones((N, 2))},
        ),
        "spokes": (jd.spokes, {"mesh": MESH, "weights": np.ones(EDGES)}),
        "stack_problems": (jd.stack_problems, {"problems": [problem, problem]}),
        "submesh": (jd.submesh, {"mesh": MESH, "free": [4], "cells": CELLS}),
        "translate": (jd.translate, {"points": MESH.vertices, "offset": [1.0, 2.0, 3.0]}),
        "twist": (jd.twist, {**move, "along": "y"}),
    }


OF_KIND = {
    "numbers": "above alpha base below center centers constant controls deformed degrees distances "
    "edge_weights field handle_weights high interval low observed offset point points power rest "
    "rigidity rotations start targets transforms translations vertices weights",
    "indices": "faces group parts r",
    "vertices": "free handles moved sources",
    "count": "columns count history_length k memory max_evaluations max_steps most n_vertices "
    "steps width",
    "tolerance": "determined_within distance radius seconds smoothness step_size "
    "target_noise threshold tolerance",
    "path": "path motion",
    "setting": "adjoint local solver",
    "flag": "edges leave_saddles normals similarity throw",
    "axis": "axis along toward up",
    "mesh": "mesh cage",
}
KINDS = {name: kind for kind, names in OF_KIND.items() for name in names.split()}
KINDS_HERE = {
    ("animate", "values"): "numbers",
    ("render_grid", "columns"): "titles",
    ("render_grid", "rows"): "titles",
    ("estimate_rigidity_thesis", "start"): "tolerance",
    ("inspect", "mesh"): "mesh-like",
    ("select.component", "vertices"): "vertices",
    ("repair", "mesh"): "mesh-like",
}


def kind_of(function: str, argument: str) -> str:
    """Return the kind of an argument: a key of the table in wrong_values.py."""
    return KINDS_HERE.get((function, argument)) or KINDS.get(argument, argument)
