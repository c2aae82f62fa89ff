"""What is measured of a policy and of its training."""
