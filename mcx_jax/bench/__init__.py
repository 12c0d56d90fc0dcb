"""`python -m mcx_jax.bench`: how fast everything is, rivals included, in one run."""
