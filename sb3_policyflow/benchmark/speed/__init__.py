"""How long trainings and environments take."""
