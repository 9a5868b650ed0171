"""How far off a fit may be: its optimum as a Gaussian, radii and intervals, and what decided them."""
