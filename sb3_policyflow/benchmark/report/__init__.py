"""Statistics over seeds, and tables."""
