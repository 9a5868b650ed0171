"""Find an object in a whole frame, in which everything else is seen as well."""
