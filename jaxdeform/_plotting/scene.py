"""Draw one view of a mesh into an array of pixels, by VTK, without a display."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxdeform._plotting.camera import View
from jaxdeform._plotting.surface import Coat, Surface

FIXED, MOVED = "#39424e", "#e0245e"

# Pixels are drawn this many times as fine, then averaged; up to the size that OpenGL allows.
_FINER, _MOST = 2, 8192

# How far the eye is, and how far what flies off is drawn, in diagonals of what is shown.
_EYE, _REACH = 200.0, 50.0

# Lights that go with the camera: where from, how strong.
_LIGHTS = (((-0.5, 0.8, 1.0), 0.52), ((1.0, 0.3, 0.5), 0.30), ((0.0, 0.0, 1.0), 0.18))


class Dots(NamedTuple):
    """The handles: which vertices, and which of them move."""

    vertices: Int[np.ndarray, "handles"]
    moved: Bool[np.ndarray, "handles"]
    """True for each that moves."""


class Stage:
    """A window in memory, in which one pose after the other is drawn."""

    def __init__(self, surface: Surface, width: int, height: int, *, edges: bool) -> None:
        """Open the window."""
        import pyvista  # slow to import, and needed only here
        from vtkmodules.vtkCommonCore import vtkLogger

        # Without a display VTK falls back to drawing in memory, which is what we want: no warning.
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
        self.surface, self.edges = surface, edges
        self.finer = _FINER if _FINER * max(width, height) <= _MOST else 1
        size = [self.finer * width, self.finer * height]
        # The decorators of pyvista hide self from pyright.
        self.plotter: Any = pyvista.Plotter(window_size=size, off_screen=True, lighting="none")
        self.plotter.set_background("white")
        self.plotter.enable_parallel_projection()
        for position, strength in _LIGHTS:
            light = pyvista.Light(light_type="camera light", intensity=strength)
            light.position = position
            self.plotter.add_light(light)

    def close(self) -> None:
        """Close the window."""
        self.plotter.close()

    def draw(
        self,
        pose: Float[np.ndarray, "vertices 3"],
        coat: Coat,
        view: View,
        dots: Dots | None,
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return the picture of a pose. What is not finite is left out."""
        plotter = self.plotter
        plotter.clear_actors()
        # Single precision is enough near the origin and at size 1, whatever the mesh's unit.
        pose = in_view(pose, view)
        self._add_surface(pose, coat)
        if dots is not None:
            self._add_dots(pose, dots)
        camera = plotter.camera
        camera.focal_point = np.zeros(3)
        camera.position = _EYE * view.toward
        camera.up = view.above
        aspect = plotter.window_size[1] / plotter.window_size[0]
        camera.parallel_scale = max(view.half_height, view.half_width * aspect) / view.depth
        camera.clipping_range = (0.5 * _EYE, 1.5 * _EYE)
        plotter.render()
        image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
        if self.finer == 1:
            return image
        h, w = (n // self.finer for n in image.shape[:2])
        blocks = image.reshape(h, self.finer, w, self.finer, 3)
        return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)

    def _add_surface(self, pose: np.ndarray, coat: Coat) -> None:
        import pyvista

        surface = self.surface
        finite = np.asarray(np.isfinite(pose).all(axis=1))
        whole = finite[surface.mesh.faces].all(axis=1)
        if not whole.any():
            return
        points = np.where(finite[:, None], pose, 0.0)[surface.index]
        normals = surface.normals(pose)
        for image, chosen, places in surface.textures if coat.textured else ():
            seen = chosen & whole
            at = surface.faces[seen].ravel()
            # Points of their own for each corner, which has its own place in the image.
            drawn = _polygons(points[at], np.arange(at.size).reshape(-1, 3), normals[at])
            if drawn is not None:
                drawn.active_texture_coordinates = places[seen].reshape(-1, 2)
                self._add(drawn, color="white", texture=pyvista.Texture(image))
            whole &= ~chosen
        drawn = _polygons(points, surface.faces[whole], normals)
        if drawn is not None:
            colors = np.rint(255 * coat.colors[surface.index]).astype(np.uint8)
            drawn.point_data["colors"] = colors
            self._add(drawn, scalars="colors", rgb=True)

    def _add(self, drawn: Any, **look: Any) -> None:
        actor = self.plotter.add_mesh(
            drawn,
            reset_camera=False,
            show_edges=self.edges,
            edge_color="#2b333d",
            edge_opacity=0.35,
            line_width=0.6 * self.finer,
            ambient=0.50,
            diffuse=0.78,
            specular=0.10,
            specular_power=12,
            **look,
        )
        actor.prop.interpolation = "Phong"

    def _add_dots(self, pose: np.ndarray, dots: Dots) -> None:
        size = self.finer * max(3.0, self.plotter.window_size[0] / self.finer / 62)
        for chosen, color in ((~dots.moved, FIXED), (dots.moved, MOVED)):
            points = pose[dots.vertices[chosen]]
            points = points[np.isfinite(points).all(axis=1)]
            if len(points):
                self.plotter.add_points(
                    points,
                    color=color,
                    point_size=size,
                    render_points_as_spheres=True,
                    reset_camera=False,
                    ambient=0.45,
                    diffuse=0.65,
                )


def _polygons(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> Any:
    """Return triangles that VTK can draw, or None for none."""
    import pyvista

    if not len(faces):
        return None
    drawn = pyvista.PolyData.from_regular_faces(points, faces)
    drawn.point_data.active_normals = normals.astype(np.float32)
    return drawn


def in_view(pose: np.ndarray, view: View) -> np.ndarray:
    """Return the pose about the middle of the view, in units of its depth.

    What flies off is pulled toward the middle until single precision can hold it, out of view.
    """
    pose = (pose - view.focus) / view.depth
    scale = np.abs(pose).max(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(scale > _REACH, pose / scale * _REACH, pose)
