"""The browser pages of ``mereo view``: a frame with its reconstruction, and the laboratory of a scene.

They only show and listen; what they show is computed in ``probe``, ``vertex_colors``, ``laboratory`` and
``scenes.parameters``.
"""
