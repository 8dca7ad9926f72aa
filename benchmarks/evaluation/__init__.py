"""The page of the evaluation, and the check that every figure in the documents has a file."""
