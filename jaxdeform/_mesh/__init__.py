"""Meshes."""

import lazy_loader

# Modules that are public, as jd.select and jd.shapes.
__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["select", "shapes"])
