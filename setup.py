"""Compiles the integer matching; everything else is in pyproject.toml."""

from setuptools import Extension, setup

best_two = Extension(
    "hloc_reduce.utils._best_two",
    ["hloc_reduce/utils/best_two.cpp"],
    extra_compile_args=["-O3", "-g0", "-std=c++17"],
    optional=True,  # where it cannot be compiled, NumPy finds the same matches
)
setup(ext_modules=[best_two])
