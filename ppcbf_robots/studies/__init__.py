"""Studies over many trainings: what a single run cannot show."""
