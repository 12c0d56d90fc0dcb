"""`python -m mcx_jax.report RUN... --out DIR`: evaluation result -> arrays -> figures -> page."""
