"""Modules that `register` adds to hloc.matchers."""
