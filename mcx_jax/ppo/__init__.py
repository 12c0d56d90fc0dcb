"""Recurrent PPO: networks, advantage estimation, sequences, losses and the compiled iteration."""
