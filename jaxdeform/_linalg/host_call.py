"""Calls from a compiled program to a NumPy function on the host, by address instead of by copy.

``jax.pure_callback`` copies every operand. It binds a program to its process, so that JAX's
compilation cache cannot keep it. And on one CPU the copy can wait for ever for the thread that the
callback itself occupies (jax issue 24255). A named FFI target has none of this: the function gets
views of XLA's own buffers, and a program that names it is as good in another process.

XLA calls a C function with the address of one struct. ctypes makes that function here, and the
layout of the structs is read from the C header that jaxlib ships: it is the layout that XLA was
compiled with (version 0.1 in jax 0.7, 0.3 in jax 0.10). Where the header is missing or unknown, and
on GPUs and TPUs, the call is a ``jax.pure_callback``.
"""

import _thread
import atexit
import contextlib
import ctypes
import re
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array

# The structs of the interface, and what is read or written of each.
_FIELDS = {
    # The argument of a call. An extension comes with it only where XLA asks, before any call, for
    # which version of the interface the function was made.
    "CallFrame": {"extension_start", "api", "stage", "args", "rets"},
    # Operands and results: how many, and the address of an array of their buffers' addresses.
    "Args": {"size", "args"},
    "Rets": {"size", "rets"},
    # One operand or result: a dense array, row-major.
    "Buffer": {"dtype", "data", "rank", "dims"},
    # The question for the version, and the answer.
    "Extension_Base": {"type"},
    "Metadata_Extension": {"metadata"},
    "Metadata": {"api_version", "traits"},
    "Api_Version": {"major_version", "minor_version"},
    # XLA's functions, of which one makes an error, and the argument of that one.
    "Api": {"XLA_FFI_Error_Create"},
    "Error_Create_Args": {"struct_size", "message", "errc"},
}
_SCALARS = {
    "size_t": ctypes.c_size_t,
    "int64_t": ctypes.c_int64,
    "uint32_t": ctypes.c_uint32,
    "int": ctypes.c_int,
}
_DTYPES = {"PRED": "?", "U8": "u1", "U32": "u4", "S32": "i4", "S64": "i8", "F32": "f4", "F64": "f8"}
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)


class Interface:
    """XLA's FFI as a C header describes it."""

    def __init__(self, header: str) -> None:
        """Read the text of the header. **Raises** LookupError where it is not as expected."""
        self._text = re.sub(r"//[^\n]*", "", header)
        self._enums = set(re.findall(r"typedef enum \{[^}]*\} (\w+);", self._text))
        self._structs: dict[str, type[ctypes.Structure]] = {}
        self.version = [int(self._find(rf"XLA_FFI_API_{x} (\d+)")) for x in ("MAJOR", "MINOR")]
        if self.version[0] != 0:
            raise LookupError(f"major version {self.version[0]}")
        for name, wanted in _FIELDS.items():
            if not wanted <= {field[0] for field in self[name]._fields_}:
                raise LookupError(f"{name} without one of {wanted}")
        self.dtypes = {self.code(f"DataType_{x}"): np.dtype(y) for x, y in _DTYPES.items()}
        self.execute = self.code("ExecutionStage_EXECUTE")
        self.metadata = self.code("Extension_Metadata")
        self.invalid_argument = self.code("Error_Code_INVALID_ARGUMENT")
        self.internal = self.code("Error_Code_INTERNAL")

    def __getitem__(self, name: str) -> type[ctypes.Structure]:
        """Return a struct, laid out as C does."""
        if name not in self._structs:
            body = self._find(rf"struct XLA_FFI_{name} {{(.*?)\n}}")
            body = re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\)", r"void* \1", body)
            lines = [line.split() for line in body.split(";") if line.strip()]
            fields = [(words[-1], self._type(words[-2])) for words in lines]
            self._structs[name] = type(name, (ctypes.Structure,), {"_fields_": fields})
        return self._structs[name]

    def _type(self, name: str) -> type:
        if name.endswith("*"):
            return ctypes.c_void_p
        if name in self._enums:
            return ctypes.c_int
        if alias := re.search(rf"typedef (\w+) {name};", self._text):
            name = alias[1]
        return _SCALARS.get(name) or self[name.removeprefix("XLA_FFI_")]

    def code(self, name: str) -> int:
        """Return the number of an enumerator."""
        return int(self._find(rf"XLA_FFI_{name} = (\d+)"))

    def _find(self, pattern: str) -> str:
        found = re.search(pattern, self._text, flags=re.DOTALL)
        if found is None:
            raise LookupError(f"no {pattern}")
        return found[1]

    def handler(self, function: Callable[..., None]) -> Callable[[int], int | None]:
        """Return what XLA calls: it runs function(*results, *operands) on views of the buffers."""
        frame_type, buffer_type = self["CallFrame"], self["Buffer"]

        def view(address: int) -> np.ndarray:
            buffer = buffer_type.from_address(address)
            dtype, rank = self.dtypes[buffer.dtype], buffer.rank
            shape = (ctypes.c_int64 * rank).from_address(buffer.dims)[:] if rank else ()
            size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
            memory = (ctypes.c_char * size).from_address(buffer.data) if size else b""
            return np.ndarray(shape, dtype, memory)

        def views(count: int, addresses: int) -> list[np.ndarray]:
            listed = (ctypes.c_void_p * count).from_address(addresses) if count else ()
            return [view(x) for x in listed]

        def handle(address: int) -> int | None:
            frame = frame_type.from_address(address)
            try:
                if _exiting:
                    raise RuntimeError("Python is about to exit")
                if self._answers(frame.extension_start):
                    return None
                if frame.stage == self.execute:
                    args, rets = frame.args, frame.rets
                    function(*views(rets.size, rets.rets), *views(args.size, args.args))
                return None
            except KeyboardInterrupt as error:
                _thread.interrupt_main()  # and again there, where a user can catch it
                return self._error(frame.api, error)
            except BaseException as error:
                return self._error(frame.api, error)

        return handle

    def _answers(self, address: int | None) -> bool:
        """Whether this was the question for the version, which has been answered now."""
        if not address or self["Extension_Base"].from_address(address).type != self.metadata:
            return False
        extension = self["Metadata_Extension"].from_address(address)
        metadata = self["Metadata"].from_address(extension.metadata)
        version = metadata.api_version
        version.major_version, version.minor_version = self.version
        metadata.traits = 0
        return True

    def _error(self, api: int, error: BaseException) -> int | None:
        args, text = self["Error_Create_Args"](), str(error)
        args.struct_size, args.errc = ctypes.sizeof(args), self.invalid_argument
        if not isinstance(error, ValueError):
            args.errc, text = self.internal, f"{type(error).__name__}: {text}"
        message = ctypes.create_string_buffer(text.encode(errors="replace"))
        args.message = ctypes.addressof(message)
        create = self["Api"].from_address(api).XLA_FFI_Error_Create
        return _FUNCTION(create)(ctypes.addressof(args))


_names: list[str] = []
_used: list[str] = []
_exiting: list[bool] = []


def _leave() -> None:
    """Let no program that still runs call Python when Python is gone.

    JAX returns before a program has ended. A call that comes while the interpreter shuts down ends
    its thread, and XLA's client, when Python frees it, waits for that thread for ever.
    """
    if _used:
        for array in jax.live_arrays("cpu"):
            with contextlib.suppress(Exception):
                array.block_until_ready()
        # What runs now has results that nobody kept. It may fail, and the client is not freed.
        _exiting.append(True)
        client = jax.devices("cpu")[0].client
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(client))


def installed_interface() -> Interface | None:
    """Return the interface of the jaxlib in use; None where its header is missing or unknown."""
    try:
        return Interface(Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text())
    except (OSError, LookupError):
        return None


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
        if interface is not None:
            if not _names:
                atexit.register(_leave)
            _names.append(name)
            pointer = _FUNCTION(interface.handler(function))
            # Threads of XLA may call it until the process ends, so it is never collected.
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(pointer))
            capsule = jax.ffi.pycapsule(ctypes.cast(pointer, ctypes.c_void_p).value)
            jax.ffi.register_ffi_target(name, capsule, platform="cpu")

    def __call__(self, result: jax.ShapeDtypeStruct, *operands: Array) -> Array:
        """Return the result of a call, traced or not."""
        if self.native and jax.default_backend() == "cpu":
            _used.append(self._name)
            return jax.ffi.ffi_call(self._name, result, vmap_method="expand_dims")(*operands)
        rank = operands[0].ndim

        def call(*given):
            arrays = [np.asarray(x) for x in given]
            lead = arrays[0].ndim - rank
            batch = np.broadcast_shapes(*(x.shape[:lead] for x in arrays))
            out = np.empty((*batch, *result.shape), result.dtype)
            self._function(out, *arrays)
            return out

        return jax.pure_callback(call, result, *operands, vmap_method="expand_dims")
