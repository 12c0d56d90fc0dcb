"""Vessel motion in waves: spectrum -> response -> tables -> sampler, and recordings."""
