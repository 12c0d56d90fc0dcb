"""Vessel-to-vessel motion compensation: sea, arm, delay, policy and training in one JAX program."""

__version__ = "0.1.0"
