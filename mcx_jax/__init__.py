"""Vessel-to-vessel motion compensation: sea, arm, delay, policy and training in one JAX program."""
