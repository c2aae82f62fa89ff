"""IsaacLab 3, as far as a training script sees it."""
