"""One script per job: `python -m pipelines.<job>`."""
