"""Other people's interfaces: Gymnasium, MuJoCo Playground, MJX."""
