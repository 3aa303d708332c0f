"""Calls from a compiled program to a NumPy function on the host, by address instead of by copy.

``jax.pure_callback`` copies every operand. It binds a program to its process, so that JAX's
compilation cache cannot keep it. And on one CPU the copy can wait for ever for the thread that the
callback itself occupies (jax issue 24255). A named FFI target has none of this: the function gets
views of XLA's own buffers, and a program that names it is as good in another process.

Where the C header of the FFI is missing or unknown (ffi.py), and on GPUs and TPUs, the call is a
``jax.pure_callback``.
"""

import atexit
import contextlib
import ctypes
import sys
import threading
import time
from collections.abc import Callable

import jax
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array

from jaxdeform._linalg.batching import side_by_side
from jaxdeform._linalg.ffi import C_FUNCTION, Interface
from jaxdeform._linalg.varying import as_varying
from jaxdeform._linalg.xla import has_accelerator

_used, _exiting = threading.Event(), threading.Event()
_running: list[str] = []


class HostFunction:
    """A NumPy function that compiled programs can call."""

    def __init__(
        self, name: str, function: Callable[..., None], interface: Interface | None
    ) -> None:
        """Register ``function(result, *operands)``, which fills the result, under a name for good.

        Under vmap all arrays get the same number of leading axes. Those of an operand that is the
        same for all have size 1.
        """
        self._name, self._function, self.native = name, function, interface is not None

        def unless_exiting(*arrays: np.ndarray) -> None:
            if _exiting.is_set():
                raise RuntimeError("Python is about to exit")
            _running.append(name)
            try:
                function(*arrays)
            finally:
                _running.pop()

        if interface is not None:
            pointer = C_FUNCTION(interface.handler(unless_exiting))
            # Threads of XLA may call it until the process ends, so it is never collected.
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(pointer))
            capsule = jax.ffi.pycapsule(ctypes.cast(pointer, ctypes.c_void_p).value)
            jax.ffi.register_ffi_target(name, capsule, platform="cpu")

    def __call__(self, result: jax.ShapeDtypeStruct, *operands: Array) -> Array:
        """Return the result of a call, traced or not."""
        if not self.native or has_accelerator():
            return self._call_back(result, *operands)
        _used.set()

        @custom_vmap
        def call(*operands):
            out = jax.ffi.ffi_call(self._name, result)(*as_varying(operands))
            return as_varying(out, operands)

        @call.def_vmap
        def call_for_all(_size, is_batched, *operands):
            shared = [x for x, own in zip(operands, is_batched, strict=True) if not own]
            own = [x for x, own in zip(operands, is_batched, strict=True) if own]

            def call(shared, own):
                rest, members = iter(shared), iter(own)
                given = [next(members) if own else next(rest)[None] for own in is_batched]
                shape = own[0].shape[0], *result.shape
                return self(jax.ShapeDtypeStruct(shape, result.dtype), *given)

            return side_by_side(call, shared, own), True

        return call(*operands)

    def _call_back(self, result: jax.ShapeDtypeStruct, *operands: Array) -> Array:
        rank = operands[0].ndim

        def call(*given):
            arrays = [np.asarray(x) for x in given]
            lead = arrays[0].ndim - rank
            batch = np.broadcast_shapes(*(x.shape[:lead] for x in arrays))
            out = np.empty((*batch, *result.shape), result.dtype)
            self._function(out, *arrays)
            return out

        return jax.pure_callback(call, result, *operands, vmap_method="expand_dims")


@atexit.register
def _leave() -> None:
    """Let no program that still runs call Python when Python is gone.

    JAX returns before a program has ended. A call that comes while the interpreter shuts down ends
    its thread, and XLA's client, when Python frees it, waits for that thread for ever.
    """
    if _used.is_set():
        # Whoever pressed Ctrl-C waits for nothing. (The traceback keeps arrays alive.)
        interrupted = isinstance(getattr(sys, "last_value", None), KeyboardInterrupt)
        for array in [] if interrupted else jax.live_arrays("cpu"):
            with contextlib.suppress(Exception):
                array.block_until_ready()
        # What runs now has results that nobody kept. It may fail, and the client is not freed.
        _exiting.set()
        while _running:
            time.sleep(1e-3)
        client = jax.devices("cpu")[0].client
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(client))
