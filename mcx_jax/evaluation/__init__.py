"""Errors of controllers on test episodes."""
