"""Named configurations, dicts of hloc's shape."""
