"""Exchange of numbers between GMIs."""
