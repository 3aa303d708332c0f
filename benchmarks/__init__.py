"""Speed and memory against libigl, Open3D and the thesis's own way: ``python -m benchmarks``."""
