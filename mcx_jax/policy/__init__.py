"""What acts: the networks, the policy file and its other forms."""
