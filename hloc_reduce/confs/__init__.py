"""Named configurations, dicts of hloc's shape; the package `confs` shows them."""
