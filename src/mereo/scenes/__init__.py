"""Built-in scenes, one module each, with a function ``scene()``; ``mereo.scene.load_scene`` finds them by name."""
