"""Training by other libraries beside gmijax, on one machine in one call."""
