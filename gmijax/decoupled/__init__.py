"""Training in which some GMIs act and others learn, at the same time; whatever the algorithm."""
