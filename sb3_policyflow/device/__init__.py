"""Rollouts that stay on the device, from environments whose steps are tensors."""
