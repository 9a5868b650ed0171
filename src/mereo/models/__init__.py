"""The networks, and the model that a user holds."""
