"""Whether an object needs weights, and from the object to them, in one command and so many minutes."""
