"""jaxdeform: differentiable mesh deformation in JAX, every part with its own rigidity."""

# What stands in __init__.pyi, each loaded when it is first used: who deforms does not wait for what
# estimates or draws.
import lazy_loader

__version__ = "0.1.0"  # pyproject.toml reads it from here

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
