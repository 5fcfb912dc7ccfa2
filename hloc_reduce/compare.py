"""`python -m pipelines.compare` under its earlier name."""

import runpy

if __name__ == "__main__":
    runpy.run_module("pipelines.compare", run_name="__main__", alter_sys=True)
