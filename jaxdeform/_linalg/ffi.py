"""XLA's foreign function interface (FFI), read from the C header that jaxlib ships.

XLA calls a C function with the address of one struct. ctypes makes that function here. The layout
of the structs is that of the header, so it is the one that XLA was compiled with (version 0.1 in
jax 0.7, 0.3 in jax 0.10, 0.4 in jax 0.11).
"""

import ctypes
import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import jax
import numpy as np

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
    "Metadata_Extension": {"extension_base", "metadata"},
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
C_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)


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
        # What an extension begins with: Extension_Base up to version 0.3, then InternalExtension.
        self._base = self._find(r"XLA_FFI_(\w+) extension_base;")
        for name, wanted in {**_FIELDS, self._base: {"type"}}.items():
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
            size = math.prod(shape) * dtype.itemsize
            memory = (ctypes.c_char * size).from_address(buffer.data) if size else b""
            return np.ndarray(shape, dtype, memoryview(memory))

        def views(count: int, addresses: int) -> list[np.ndarray]:
            listed = (ctypes.c_void_p * count).from_address(addresses) if count else ()
            return [view(x) for x in listed]

        def handle(address: int) -> int | None:
            frame = frame_type.from_address(address)
            try:
                if self._answers(frame.extension_start):
                    return None
                if frame.stage == self.execute:
                    args, rets = frame.args, frame.rets
                    function(*views(rets.size, rets.rets), *views(args.size, args.args))
                return None
            except BaseException as error:  # what left this function would be lost
                return self._error(frame.api, error)

        return handle

    def _answers(self, address: int | None) -> bool:
        """Whether this was the question for the version, which has been answered now."""
        if not address or self[self._base].from_address(address).type != self.metadata:
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
        return C_FUNCTION(create)(ctypes.addressof(args))


@cache
def installed_interface() -> Interface | None:
    """Return the interface of the jaxlib in use; None where its header is missing or unknown."""
    try:
        return Interface(Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text())
    except (OSError, LookupError, ValueError, re.error):
        return None
