"""Compiles the integer matching; everything else is in pyproject.toml.

The library has no code for Python, so that one serves all versions. With HLOC_REDUCE_PURE=1 it is
left out, and NumPy finds the same matches.
"""

import os

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

best_two = Extension(
    "hloc_reduce.utils._best_two",
    ["hloc_reduce/utils/best_two.cpp"],
    export_symbols=["best_two_name", "best_two", "best_both"],
    py_limited_api=True,
    # where it cannot be compiled, there is none; wheels that are published must have it
    optional="HLOC_REDUCE_COMPILED" not in os.environ,
)


class BuildLibrary(build_ext):
    """Builds a library that is loaded by ctypes, not imported."""

    def build_extension(self, ext: Extension) -> None:
        """Compile with the options of the compiler."""
        is_msvc = self.compiler.compiler_type == "msvc"
        ext.extra_compile_args = (
            ["/O2", "/std:c++17", "/EHsc"] if is_msvc else ["-O3", "-g0", "-std=c++17"]
        )
        super().build_extension(ext)

    def get_export_symbols(self, ext: Extension) -> list[str]:
        """Return the functions that Windows exports: no `PyInit_*`, unlike modules."""
        return ext.export_symbols


is_pure = bool(os.environ.get("HLOC_REDUCE_PURE"))
setup(
    ext_modules=[] if is_pure else [best_two],
    cmdclass={"build_ext": BuildLibrary},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
