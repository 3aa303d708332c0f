"""Calls to the host by both ways, and what is read from XLA's header."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeform._linalg.ffi import Interface, installed_interface
from jaxdeform._linalg.host_call import HostFunction

HEADER = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text()


def scaled_sum(out, scale, x):
    """out = scale x, for a scale of shape (..., 1) and x of shape (..., k)."""
    if np.any(scale < 0):
        raise ValueError("scale is negative: ünlike 0")
    if np.any(scale > 100):
        raise KeyError("too large")
    if np.any(scale == 99):
        raise KeyboardInterrupt
    out[...] = scale * x


FUNCTIONS = {
    "FFI": HostFunction("jaxdeform_test_scaled", scaled_sum, installed_interface()),
    "callback": HostFunction("unused", scaled_sum, None),
}


@pytest.fixture(params=FUNCTIONS)
def scaled(request):
    function = FUNCTIONS[request.param]
    return jax.jit(lambda scale, x: function(jax.ShapeDtypeStruct(x.shape, x.dtype), scale, x))


def test_this_jax_has_the_fast_way():
    assert installed_interface() is not None
    assert FUNCTIONS["FFI"].native
    assert not FUNCTIONS["callback"].native


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.int64, np.uint32, np.uint8])
def test_values_of_each_type(scaled, dtype):
    x = jnp.arange(5).astype(dtype)
    out = scaled(x[3:4], x)
    assert out.dtype == dtype
    np.testing.assert_array_equal(out, np.arange(5) * 3)


@pytest.mark.parametrize("shape", [(), (1,), (0,), (2, 0, 3), (2, 3, 4, 5)])
def test_shapes(scaled, shape):
    x = np.random.default_rng(0).normal(size=shape)
    out = scaled(np.full((1,) * len(shape), 2.0), x)
    assert out.shape == shape
    np.testing.assert_array_equal(out, 2 * x)


def test_vmap_gives_equal_operands_an_axis_of_size_one(scaled):
    x, scale = np.random.default_rng(0).normal(size=(3, 4)), np.array([[2.0], [3.0]])
    np.testing.assert_array_equal(jax.vmap(scaled, (None, 0))(scale[0], x), 2 * x)
    np.testing.assert_array_equal(jax.vmap(scaled, (0, None))(scale, x[0]), scale * x[0])
    both = jax.jit(jax.vmap(jax.vmap(scaled, (None, 0)), (0, None)))(scale, x)
    np.testing.assert_array_equal(both, scale[:, :, None] * x)


def test_errors_are_told(scaled):
    x = jnp.ones(4)
    with pytest.raises(Exception, match="scale is negative: ünlike 0"):
        scaled(-x[:1], x).block_until_ready()
    with pytest.raises(Exception, match="KeyError: 'too large'"):
        scaled(101 * x[:1], x).block_until_ready()
    np.testing.assert_array_equal(scaled(x[:1], x), x)


def test_an_interrupt_arrives(scaled):
    """Python runs signal handlers between two instructions of whatever the main thread does."""
    x = jnp.ones(4)
    with pytest.raises(Exception, match="KeyboardInterrupt"):
        scaled(99 * x[:1], x).block_until_ready()


def test_nothing_is_copied():
    seen = []

    def note(out, x):
        seen.append(x.ctypes.data)
        out[...] = x

    function = HostFunction("jaxdeform_test_note", note, installed_interface())
    x = jnp.arange(1000.0)
    same = jax.jit(lambda x: function(jax.ShapeDtypeStruct(x.shape, x.dtype), x))(x)
    np.testing.assert_array_equal(same, x)
    assert seen == [x.unsafe_buffer_pointer()]


# ---------------------------------------------------------------- the header


def test_layout_is_read_from_the_header():
    """A field more, in the middle of a struct that is itself a part of another."""
    changed = re.sub(r"(struct XLA_FFI_Args \{)", r"\1\n  const char* name;  // new\n", HEADER)
    old, new = Interface(HEADER), Interface(changed)
    assert new["Args"].size.offset == old["Args"].size.offset + 8
    assert new["CallFrame"].args.offset == old["CallFrame"].args.offset
    assert new["CallFrame"].rets.offset == old["CallFrame"].rets.offset + 8
    assert new.version == old.version


def test_layout_of_the_first_version():
    """jax 0.7: version 0.1, metadata without the last field."""
    first = re.sub(r"#define XLA_FFI_API_MINOR \d+", "#define XLA_FFI_API_MINOR 1", HEADER)
    first = re.sub(r"\n *XLA_FFI_TypeId state_type_id;", "", first)
    assert Interface(first).version == [0, 1]
    assert [name for name, *_ in Interface(first)["Metadata"]._fields_][-1] == "traits"


@pytest.mark.parametrize("name", ["Extension_Base", "InternalExtension"])
def test_the_base_of_an_extension_has_two_names(name):
    """Version 0.4, in jax 0.11, calls it InternalExtension."""
    header = re.sub(r"XLA_FFI_(Extension_Base|InternalExtension)\b", f"XLA_FFI_{name}", HEADER)
    base = dict(Interface(header)["Metadata_Extension"]._fields_)["extension_base"]
    assert base.__name__ == name


@pytest.mark.parametrize(
    ("pattern", "replacement"),
    [
        (r"XLA_FFI_API_MAJOR 0", "XLA_FFI_API_MAJOR 1"),
        (r"#define XLA_FFI_API_MINOR \d+", ""),
        (r"int64_t rank;", "int64_t dimensions;"),
        (r"int64_t rank;", "std::vector<int64_t> rank;"),
        (r"struct XLA_FFI_Metadata_Extension \{", "struct XLA_FFI_Other {"),
        (r"XLA_FFI_DataType_F64 = 12,", ""),
        (r"_XLA_FFI_API_STRUCT_FIELD\(XLA_FFI_Error_Create\);", ""),
    ],
)
def test_an_unknown_header_means_callbacks(pattern, replacement, tmp_path, monkeypatch):
    assert re.search(pattern, HEADER)
    file = tmp_path / "xla" / "ffi" / "api" / "c_api.h"
    file.parent.mkdir(parents=True)
    file.write_text(re.sub(pattern, replacement, HEADER))
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    assert installed_interface.__wrapped__() is None
    file.unlink()
    assert installed_interface.__wrapped__() is None
