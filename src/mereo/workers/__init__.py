"""One function over many items: here, in processes of this machine, or in tasks of a Ray cluster."""
