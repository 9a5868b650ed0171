"""The browser pages of ``mereo view``: a frame with its reconstruction, and the laboratory of a scene.

They only show and listen; what they show is computed in ``inspection``, ``coloring``, ``laboratory`` and ``freedoms``.
"""
