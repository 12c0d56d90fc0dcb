"""A training run on the disk: loop, directory, checkpoints, progress."""
