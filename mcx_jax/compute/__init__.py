"""How XLA is made to run the program fast; the only place that knows about it."""
