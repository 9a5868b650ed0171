"""A frame answered by the registered model: fitted, believed or not, recognized, carried, and kept as a state file."""
