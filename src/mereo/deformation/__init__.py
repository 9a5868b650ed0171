"""Maps of space: bends, lattices, fields, tetrahedra, and how random ones are drawn."""
