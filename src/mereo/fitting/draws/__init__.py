"""A scene's own random draws that explain a frame: states that the scene really has."""
