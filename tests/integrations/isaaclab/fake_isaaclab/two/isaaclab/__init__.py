"""IsaacLab 2, as far as a training script sees it."""
