"""A short run of the fuzzer; ``python -m tests.fuzz`` makes a long one."""

import importlib.util
from pathlib import Path

_spec = importlib.util.spec_from_file_location("fuzz", Path(__file__).with_name("fuzz.py"))
fuzz = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(fuzz)


def test_broken_files_are_refused_or_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert fuzz.run([], 1, 150, 0.0) == []


def test_a_fault_is_found(tmp_path, monkeypatch):
    def read(path):
        raise IndexError("beyond the end")

    def slow(path):
        while True:
            pass

    monkeypatch.setattr(fuzz, "LIMIT", 0.2)
    for wrong, said in ((read, "IndexError: beyond"), (slow, "TimeoutError")):
        reader = fuzz.Reader(wrong, "broken.obj", [b"v 0 0 0"])
        assert fuzz.fault_of(reader, b"v", tmp_path).startswith(said)
    reader = fuzz.readers(tmp_path)["obj"]
    assert fuzz.fault_of(reader, reader.seeds[0], tmp_path) is None
