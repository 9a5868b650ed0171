"""From an object to weights that answer, in one command and so many minutes."""
