"""Learning by the gradient of the error THROUGH the simulator, in short windows."""
