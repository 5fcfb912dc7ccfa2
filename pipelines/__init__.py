"""One script per job: `python -m pipelines.<job>`."""

import hloc_reduce  # noqa: F401, before what takes seconds to import, so that Ctrl-C is heard
