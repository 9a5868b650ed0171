"""Built-in scenes, one module each, with a function ``scene()``, by which ``mereo.load_scene`` finds them."""
