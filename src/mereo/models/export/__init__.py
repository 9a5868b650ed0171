"""Networks as graphs, and the runner that travels with them."""
