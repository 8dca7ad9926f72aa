"""Asynchronous actor-critic training: agents act, trainers learn, and neither waits its turn."""
