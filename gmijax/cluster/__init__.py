"""A job on several machines, which Ray finds and watches."""
