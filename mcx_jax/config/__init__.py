"""What can be set: the task, training, delays, and how a command line becomes them."""
