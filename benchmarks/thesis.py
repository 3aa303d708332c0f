"""The thesis's way in NumPy: one vertex after the other, gradient descent on Eq. 4.3.

It is what chapter 4 describes, made no slower: everything that does not change (edges, weights, B,
the factor of A) is computed once, and each vertex's C is one matrix product. The step is one over a
bound on the curvature, the safe choice where the thesis names none. The descent of a vertex ends
after 100 steps, or when its gradient is below 1e-4 of the size of the cell's coefficients.
"""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

import jaxdeform as jd


class ThesisDeformation:
    """Alternating minimisation of Eq. 4.4 with a Python loop over the vertices."""

    def __init__(self, mesh: jd.Mesh, handles: np.ndarray, cells: jd.Cells) -> None:
        n = mesh.n_vertices
        i, j = cells.edges.T
        self.edge = mesh.vertices[i] - mesh.vertices[j]
        self.ends, self.weights = (i, j), cells.weights
        table = cells.membership
        self.cells = [table.indices[table.indptr[k] : table.indptr[k + 1]] for k in range(n)]
        self.weighted = [self.weights[e, None] * self.edge[e] for e in self.cells]
        self.b = [w.T @ self.edge[e] for w, e in zip(self.weighted, self.cells, strict=True)]
        weight = cells.overlap * cells.weights
        difference = sp.csr_matrix(
            (np.tile([1.0, -1.0], len(i)), (np.repeat(np.arange(len(i)), 2), cells.edges.ravel())),
            shape=(len(i), n),
        )
        a = (difference.T @ sp.diags(weight) @ difference).tocsc()
        self.handles, self.free = handles, np.setdiff1d(np.arange(n), handles)
        self.coupling = a[self.free][:, handles]
        self.solve = scipy.sparse.linalg.factorized(a[self.free][:, self.free].tocsc())

    def affine_fits(self, p: np.ndarray) -> list[np.ndarray]:
        """Eq. 4.6, the thesis's start of T. Flat cells have no inverse, hence pinv."""
        moved = p[self.ends[0]] - p[self.ends[1]]
        return [
            np.linalg.pinv(b) @ (w.T @ moved[e])
            for b, w, e in zip(self.b, self.weighted, self.cells, strict=True)
        ]

    def local_step(self, p: np.ndarray, transforms: list[np.ndarray], rigidity: float) -> None:
        moved = p[self.ends[0]] - p[self.ends[1]]
        identity = np.eye(3)
        for k, e in enumerate(self.cells):
            b, ct = self.b[k], (self.weighted[k].T @ moved[e]).T
            t = transforms[k]
            size = rigidity + np.abs(b).max()
            # The Hessian is below 4 lambda (3 |T|^2) + 2 |B|.
            bound = 12 * rigidity * max(1.0, (t * t).sum()) + 2 * np.linalg.norm(b)
            for _ in range(100):
                gradient = 4 * rigidity * t @ (t.T @ t - identity) + 2 * (t @ b - ct)
                t = t - gradient / bound
                if (gradient * gradient).sum() < (1e-4 * size) ** 2:
                    break
            transforms[k] = t

    def global_step(self, targets: np.ndarray, transforms: list[np.ndarray]) -> np.ndarray:
        n = len(self.cells)
        right = np.zeros((n, 3))
        for k, e in enumerate(self.cells):
            pull = self.weighted[k] @ transforms[k].T
            np.add.at(right, self.ends[0][e], pull)
            np.add.at(right, self.ends[1][e], -pull)
        p = np.empty((n, 3))
        p[self.handles] = targets
        rest = right[self.free] - self.coupling @ targets
        p[self.free] = np.stack([self.solve(column) for column in rest.T], axis=1)
        return p

    def iterate(self, targets, start, rigidity: float, steps: int):
        """Yield the positions after each iteration."""
        p = start.copy()
        p[self.handles] = targets
        transforms = [t.T for t in self.affine_fits(p)]
        for _ in range(steps):
            self.local_step(p, transforms, rigidity)
            p = self.global_step(targets, transforms)
            yield p
